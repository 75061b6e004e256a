# SPDX-License-Identifier: Apache-2.0
r"""Plan very often: memory stays as it is, and plans take as long at the end as at the start.

    python tools/bench.py soak pendulum --plans 1000000
    python tools/bench.py soak omni_push_box --plans 100000

Observations and plans go through the arrays and latest-value buffers of `warpmpc run --real-time`, planning and agent
are its own; the plant moves on by one control for every plan and starts again when it is done. Prints resident memory
and plan times every tenth of the way. Exit code 1 if memory grew by more than --growth from the first tenth to the
last, or the median plan time by more than --slower.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from warpmpc import Controller, load_scene, simulated_robot
from warpmpc.loop.realtime.agent import Agent
from warpmpc.loop.realtime.messages import LatestValue, ObservationCodec, PlanCodec, TimedObservation
from warpmpc.loop.realtime.planning import Planning
from warpmpc.scene.schema import Scene


@dataclass(frozen=True)
class Tenth:
    """A tenth of all plans."""

    plans: int
    """Plans up to its end."""
    memory: float
    """Resident memory at its end [MB]."""
    p50: float
    """Wall time from observation to plan [ms]."""
    p99: float
    worst: float
    faults: int
    """Times so far in which no plan was followed."""


def resident() -> float:
    """Resident memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return 1e-6 * pages * resource.getpagesize()


def soak(scene: Scene, plans: int, *, seed: int = 0) -> Iterator[Tenth]:
    """Make plans in closed loop, ten times a tenth of them."""
    scene = scene.model_copy(
        update={"agent": scene.agent.model_copy(update={"rate": 1.0 / scene.timing.control_dt, "plan_timeout": 1.0})}
    )
    controller = Controller(scene, device="cpu", seed=seed)
    planning, layout = Planning(controller, latency=scene.timing.control_dt), controller.layout
    robot = simulated_robot(scene, seed=seed, task=controller.task, compiled=controller.compiled)
    context = multiprocessing.get_context("spawn")
    observations = ObservationCodec(layout, controller.task.block.shape[1])
    codec = PlanCodec(layout, len(controller.plan_step.plan_spline.times))
    seen, planned = LatestValue(context, observations.capacity), LatestValue(context, codec.capacity)
    agent, command, acting = Agent(scene, layout), np.zeros(layout.nu, np.float32), None
    faults = 0
    for tenth in range(10):
        times = []
        for _ in range(plans // 10):
            if robot.done:
                faults += len(agent.faults)
                robot.reset()
                controller.reset()
                agent, acting = Agent(scene, layout), None
            state = robot.observe()
            observation = TimedObservation(state, command, agent.following, task=controller.task.block[0])
            seen.write(observations.encode(observation))
            timed = planning.plan(observations.decode(seen.read()))
            planned.write(codec.encode(timed))
            times.append(1e3 * timed.latency)
            command = agent.command(state, acting, robot.time)
            acting = codec.decode(planned.read())
            robot.apply(command)
        p50, p99, worst = np.percentile(times, [50, 99, 100]).tolist()
        found = faults + len(agent.faults)
        yield Tenth((tenth + 1) * (plans // 10), resident(), p50, p99, worst, found)


def complaints(tenths: list[Tenth], *, growth: float, slower: float) -> list[str]:
    """What is not as it was, in sentences.

    Args:
        tenths: All of them.
        growth: Memory that may be added [MB].
        slower: Factor by which the median plan time may grow.
    """
    first, last = tenths[0], tenths[-1]
    found = []
    if last.memory - first.memory > growth:
        found.append(f"memory grew by {last.memory - first.memory:.1f} MB")
    if last.p50 > slower * first.p50:
        found.append(f"plans took {last.p50 / first.p50:.2f} times as long at the end")
    return found


def main(arguments: list[str]) -> int:
    """Run and print; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="scene, or scene:variant")
    parser.add_argument("--plans", type=int, default=100_000)
    parser.add_argument("--growth", type=float, default=20.0, help="[MB]")
    parser.add_argument("--slower", type=float, default=1.2, help="factor")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change the scene")
    options = parser.parse_args(arguments)
    tenths = []
    for tenth in soak(load_scene(options.scene, overrides=options.set), options.plans):
        tenths.append(tenth)
        print(json.dumps(asdict(replace(tenth, memory=round(tenth.memory, 2)))), flush=True)
    found = complaints(tenths, growth=options.growth, slower=options.slower)
    print(*(found or ["memory and plan times are as they were"]), sep="\n")
    return 1 if found else 0
