# SPDX-License-Identifier: Apache-2.0
r"""Control a robot over ROS 2 for long: no fault, and memory stays as it is.

    python tools/bench.py soak_wire cartpole_swingup --seconds 3600 --json docs/data/soak.json

The robot is `warpmpc robot SCENE --ros2` in a separate process, the planner another, agent and driver are here, as in
`warpmpc run --real-time --robot ros2`; but the run goes on after its goal. Prints a line every tenth of the way:
resident memory of the three processes, ticks, plans, faults. Exit code 1 if there was a fault, the robot refused a
command or had an unsafe one, or a process grew by more than --growth after that.
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
from shared.wire import start_robot

from warpmpc import PlannerProcess, RobotLoop, load_scene
from warpmpc.loop.robots.drivers import await_state, make_robot
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.schema import Scene
from warpmpc.scene.task.task import Task

TENTHS = 10
COLUMNS = ["scene", "ticks", "plans", "faults", "late p99 [ms]", "memory of robot, agent, planner [MB]", "robot"]


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
    faults: int
    """Times so far in which no plan was followed."""


def resident(pid: int | str = "self") -> float:
    """Resident memory of a process [MB]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return 1e-6 * pages * resource.getpagesize()


def soak(
    scene: Scene, source: str, seconds: float, *, overrides: list[str]
) -> tuple[list[Tenth], float, dict[str, Any]]:
    """Run for so long.

    Returns:
        The tenths, each of which is printed; the 99th percentile of the lateness of the newest ticks [ms]; the robot's
        report.

    Raises:
        ValueError: If the robot is not there.
    """
    with tempfile.TemporaryDirectory() as folder:
        topics = Path(folder) / "topics.toml"
        topics.write_text(f'namespace = "soak_{os.getpid()}"\nconnect_timeout = 120.0\n')
        changes = [part for change in overrides for part in ("--set", change)]
        robot = start_robot(source, ["--ros2", "--topics", str(topics), *changes], stdout=subprocess.PIPE)
        try:
            tenths, late = _control(scene, f"ros2:{topics}", robot, seconds)
        finally:
            robot.send_signal(signal.SIGINT)
            out, _ = robot.communicate(timeout=60.0)
    return tenths, late, json.loads(out)


def _control(scene: Scene, choice: str, robot: subprocess.Popen, seconds: float) -> tuple[list[Tenth], float]:
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
                memory = (resident(robot.pid), resident(), resident(planner.pid))
                tenths.append(Tenth(end, *memory, loop.ticks, loop.plans, len(loop.agent.faults)))
                print(json.dumps(asdict(tenths[-1])), flush=True)
                return len(tenths) == TENTHS

            report = loop.run(over)  # percentiles take several ticks: there is one report, at the end
    finally:
        driver.close()
    return tenths, report.jitter_ms["p99"]


def complaints(tenths: list[Tenth], robot: dict[str, Any], *, growth: float) -> list[str]:
    """What is not as it was, in sentences.

    Args:
        tenths: All of them.
        robot: The robot's report.
        growth: Memory that may be added by each process after the first tenth [MB].
    """
    first, last = tenths[0], tenths[-1]
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


def row(scene: str, tenths: list[Tenth], late: float, robot: dict[str, Any]) -> list[str]:
    """Cells of the table."""
    first, last = tenths[0], tenths[-1]
    memory = (
        f"{getattr(first, name):.1f} after {first.seconds / 60:.0f} min, {getattr(last, name):.1f} at the end"
        for name in ("robot_mb", "agent_mb", "planner_mb")
    )
    told = f"{robot['received']} commands, {sum(robot['refused'].values())} refused, {robot['unsafe']} unsafe"
    counts = (f"{last.ticks:,}", f"{last.plans:,}", str(last.faults))
    return [f"`{scene}`", *counts, f"{late:.2f}", "; ".join(memory), told]


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
    tenths, late, robot = soak(scene, options.scene, options.seconds, overrides=options.set)
    found = complaints(tenths, robot, growth=options.growth)
    print(json.dumps(robot))
    print(*(found or ["no fault, memory is as it was"]), sep="\n")
    if options.json:
        here = machine()
        group = {
            "machine": f"{here['cpu']}, {here['cores']} cores",
            "date": date.today().isoformat(),
            "command": shlex.join(["python", "tools/bench.py", "soak_wire", *arguments]),
            "rows": [row(options.scene, tenths, late, robot)],
        }
        put_group(options.json, COLUMNS, group)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
