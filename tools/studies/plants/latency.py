# SPDX-License-Identifier: Apache-2.0
r"""What latency does to a scene, with and without predicting observations forward by it.

    python tools/study.py latency cartpole_swingup --latency 0 20 40 80 --seeds 3
    python tools/study.py latency acrobot --without-gains    # commands are the plan's, whatever the state

Planner, agent and plant are those of `warpmpc run --real-time`, but the clock is not: every plan takes the latency that
is asked for, on the plant's clock, however fast the machine is. The next observation is taken when a plan is ready, and
at most one for every control. Prints successes and the mean time to the goal, the timeout where it was missed.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from warpmpc import Controller, Plant, load_scene, simulated_robot
from warpmpc.loop.realtime.agent import Agent
from warpmpc.loop.realtime.messages import TimedObservation, TimedPlan
from warpmpc.loop.realtime.planning import Planning
from warpmpc.scene.draw import draw_task
from warpmpc.scene.schema import Scene


def delayed_episode(scene: Scene, *, latency: float, compensate: bool, gains: bool = True, seed: int = 0) -> Plant:
    """Run an episode in which every plan is as old as the latency when it arrives; returns its plant.

    Args:
        scene: The scene.
        latency: From observation to plan [s].
        compensate: Whether observations are predicted forward.
        gains: Whether commands answer what is observed, where plans have gains.
        seed: Seed of the task, the controller and the plant.
    """
    settings = scene.agent.model_copy(update={"compensate": compensate, "plan_timeout": 3.0 * latency + 0.1})
    scene = draw_task(scene.model_copy(update={"agent": settings}), seed)[0]
    controller = Controller(scene, device="cpu", seed=seed)
    planning = Planning(controller, latency=latency)
    robot = simulated_robot(scene, seed=seed, task=controller.task, compiled=controller.compiled)
    agent = Agent(scene, controller.layout)
    acting: TimedPlan | None = None
    coming: tuple[float, TimedPlan] | None = None
    begin = 0.0  # of the next plan
    command = np.zeros(controller.layout.nu, dtype=np.float32)
    while not robot.done:
        state = robot.observe()
        if coming is not None and robot.time >= coming[0] - 1e-9:
            acting, coming = coming[1], None
        command = agent.command(state, acting, robot.time)
        if coming is None and robot.time >= begin - 1e-9:
            timed = planning.plan(TimedObservation(state, command, agent.following))
            plan = timed.plan if gains else replace(timed.plan, feedback=None)
            coming = robot.time + latency, replace(timed, plan=plan, latency=latency)
            begin = robot.time + scene.timing.control_dt
        robot.apply(command)
    return robot


def main(arguments: list[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", help="scene, or scene:variant")
    parser.add_argument("--latency", type=float, nargs="+", default=[0.0, 20.0, 40.0, 80.0, 120.0], help="[ms]")
    parser.add_argument("--seeds", type=int, default=3, help="episodes of each row")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--without-gains", action="store_true", help="commands are the plan's, whatever the state")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change the scene")
    options = parser.parse_args(arguments)
    scene = load_scene(options.scene, overrides=options.set)
    print("latency [ms]  compensated  successes  mean time [s]")
    for latency in options.latency:
        for compensate in (True, False) if latency else (True,):
            runs = [
                delayed_episode(
                    scene, latency=1e-3 * latency, compensate=compensate, gains=not options.without_gains, seed=seed
                )
                for seed in range(options.first, options.first + options.seeds)
            ]
            won, time = sum(run.success for run in runs), np.mean([run.time for run in runs])
            print(f"{latency:12g}  {compensate!s:>11}  {won:>6}/{options.seeds}  {time:13.2f}", flush=True)
