# SPDX-License-Identifier: Apache-2.0
r"""Control a robot over ROS 2 for long: no fault, and memory stays as it is.

    python tools/bench.py soak_wire cartpole_swingup --seconds 3600 --json docs/data/soak.json

The robot is `warpmpc robot SCENE --ros2` in a process of its own, the planner another, agent and driver are here, as in
`warpmpc run --real-time --robot ros2`; but the run goes on after its goal. Prints a line every tenth of the way:
resident memory of the three processes, ticks, lateness of ticks, age of observations, faults. Exit code 1 if there was
a fault, the robot refused a command or had an unsafe one, or a process grew by more than --growth after the tenth at
whose end the lists of newest ticks, observations and commands were full.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

from shared.files import put_group
from shared.machine import machine

from warpmpc import PlannerProcess, RobotLoop, load_scene
from warpmpc.model.compiled import compile_scene
from warpmpc.realtime.pace import LONGEST
from warpmpc.robots.drivers import await_state, make_robot
from warpmpc.scene.schema import Scene
from warpmpc.task.task import Task

TENTHS = 10
COLUMNS = ["scene", "ticks", "plans", "faults", "late p99/max [ms]", "memory of robot, agent, planner [MB]", "robot"]
PROGRAM = [sys.executable, "-m", "warpmpc.cli.main"]


@dataclass(frozen=True)
class Tenth:
    """A tenth of the time."""

    seconds: float
    """Time at its end, since the planner is there [s]."""
    robot_mb: float
    """Resident memory of the robot's process at its end [MB]."""
    agent_mb: float
    """That of the process of agent and driver."""
    planner_mb: float
    """That of the planner's process."""
    ticks: int
    """Ticks so far."""
    plans: int
    """Plans so far."""
    jitter_ms: dict[str, float]
    """Lateness of the newest ticks, in wall time [ms]."""
    age_ms: dict[str, float]
    """Age of the newest observations at ticks [ms]."""
    faults: int
    """Times so far in which no plan was followed."""


def resident(pid: int | str = "self") -> float:
    """Resident memory of a process [MB]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return 1e-6 * pages * resource.getpagesize()


def soak(scene: Scene, source: str, seconds: float, *, overrides: list[str]) -> tuple[list[Tenth], dict[str, Any]]:
    """Run for so long; returns the tenths, each of which is printed, and the robot's report.

    Raises:
        ValueError: If the robot is not there.
    """
    with tempfile.TemporaryDirectory() as folder:
        topics = Path(folder) / "topics.toml"
        topics.write_text(f'namespace = "soak_{os.getpid()}"\nconnect_timeout = 120.0\n')
        changes = [part for change in overrides for part in ("--set", change)]
        command = [*PROGRAM, "robot", source, "--ros2", "--topics", str(topics), *changes]
        robot = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            tenths = _control(scene, f"ros2:{topics}", robot, seconds)
        finally:
            robot.send_signal(signal.SIGINT)
            out, _ = robot.communicate(timeout=60.0)
    return tenths, json.loads(out)


def _control(scene: Scene, choice: str, robot: subprocess.Popen, seconds: float) -> list[Tenth]:
    compiled, task = compile_scene(scene), Task(scene)
    driver = make_robot(choice, scene, seed=0, task=task, terms=(), watch=(), compiled=compiled)
    tenths: list[Tenth] = []
    try:
        await_state(driver, choice)
        with PlannerProcess(scene, task=task, compiled=compiled, device="cpu") as planner:
            loop, begin = RobotLoop(scene, driver, planner), time.monotonic()

            def over() -> bool:
                end = time.monotonic() - begin
                if end < seconds * (len(tenths) + 1) / TENTHS:
                    return False
                report = loop.report()
                memory = (resident(robot.pid), resident(), resident(planner.pid))
                found = (end, *memory, report.ticks, report.plans, report.jitter_ms, report.age_ms, len(report.faults))
                tenths.append(Tenth(*found))
                print(json.dumps(asdict(tenths[-1])), flush=True)
                return len(tenths) == TENTHS

            loop.run(over)
    finally:
        driver.close()
    return tenths


def complaints(tenths: list[Tenth], robot: dict[str, Any], *, growth: float) -> list[str]:
    """What is not as it was, in sentences.

    Args:
        tenths: All of them.
        robot: The robot's report.
        growth: Memory that may be added by each process after :func:`full` [MB].
    """
    first, last = full(tenths), tenths[-1]
    found = []
    for process in ("robot", "agent", "planner"):
        more = getattr(last, f"{process}_mb") - getattr(first, f"{process}_mb")
        if more > growth:
            found.append(f"memory of the {process}'s process grew by {more:.1f} MB")
    if last.faults:
        found.append(f"{last.faults} faults")
    refused = {kind: count for kind, count in robot["refused"].items() if count}
    if refused:
        found.append(f"the robot refused commands: {refused}")
    if robot["unsafe"]:
        found.append(f"{robot['unsafe']} unsafe commands")
    return found


def full(tenths: list[Tenth]) -> Tenth:
    """The tenth at whose end the lists of newest ticks, observations and commands are full, or the first."""
    return next((tenth for tenth in tenths if tenth.ticks >= LONGEST), tenths[0])


def row(scene: str, tenths: list[Tenth], robot: dict[str, Any]) -> list[str]:
    """Cells of the table."""
    first, last = full(tenths), tenths[-1]
    memory = (
        f"{getattr(first, name):.1f} at {first.seconds / 60:.0f} min, {getattr(last, name):.1f} at the end"
        for name in ("robot_mb", "agent_mb", "planner_mb")
    )
    late = max(tenth.jitter_ms["p99"] for tenth in tenths), max(tenth.jitter_ms["max"] for tenth in tenths)
    told = f"{robot['received']} commands, {sum(robot['refused'].values())} refused, {robot['unsafe']} unsafe"
    counts = (f"{last.ticks:,}", f"{last.plans:,}", str(last.faults))
    return [f"`{scene}`", *counts, f"{late[0]:.2f}/{late[1]:.1f}", "; ".join(memory), told]


def main(arguments: list[str]) -> int:
    """Run and print; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", default="cartpole_swingup", help="scene, or scene:variant")
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--growth", type=float, default=5.0, help="[MB]")
    parser.add_argument("--json", type=Path, metavar="FILE", help="put the figures there, as docs/data has them")
    parser.add_argument("--set", action="append", default=["engine.threads=1"], metavar="KEY=VALUE")
    options = parser.parse_args(arguments)
    scene = load_scene(options.scene, overrides=options.set)
    tenths, robot = soak(scene, options.scene, options.seconds, overrides=options.set)
    found = complaints(tenths, robot, growth=options.growth)
    print(json.dumps(robot))
    print(*(found or ["no fault, memory is as it was"]), sep="\n")
    if options.json:
        here = machine()
        group = {
            "machine": f"{here['cpu']}, {here['cores']} cores",
            "date": date.today().isoformat(),
            "command": shlex.join(["python", "tools/bench.py", "soak_wire", *arguments]),
            "rows": [row(options.scene, tenths, robot)],
        }
        put_group(options.json, COLUMNS, group)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
