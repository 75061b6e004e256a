# SPDX-License-Identifier: Apache-2.0
"""A robot and a planner as two processes that know messages of each other alone."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, Queue
from typing import Any

from shared.ports import free_port

TOOLS = Path(__file__).parents[1]
PROGRAM = [sys.executable, "-m", "warpmpc.cli.main"]
PATIENCE = 120.0
"""Wall time for which an answer is waited for [s]."""
DRILL = """
[timing]
control_dt = 0.04
timeout = 600.0

[[robot]]
name = "base"
asset = "point_robot.urdf"
ground_contact = false
frames.centre = { link = "base_link" }
drive = { damping = 300.0, effort_limit = 200.0, limit = [1.0, 1.0, 1.0] }

[goal]
frame = "base/centre"
position = [90.0, 0.0]

[[cost]]
term = "distance"
between = ["base/centre", "goal"]

[planner]
samples = 32
horizon = 6

[engine]
threads = 1

[plant]
randomize = false

[success]
distance = 0.1
"""
"""A disc on a long way; zero velocity is its safe command."""


@dataclass(frozen=True)
class Ends:
    """Both ends of a transport, at a place: a port or another number that nobody else uses."""

    driver: str
    """Name of the driver at the other end."""
    place: Callable[[], int]
    """Finds a free place."""
    options: Callable[[int, Path], list[str]]
    """Options of ``warpmpc robot`` that make it, beside the driver's file."""
    settings: Callable[[int], str]
    """Text of the driver's file at the other end."""


def _ros2(keys: str) -> Ends:
    """Topics in a separate namespace; the simulated robot has the driver's file, too."""

    def settings(place: int) -> str:
        return f'namespace = "wire_{place}"\nconnect_timeout = 60.0\nuse_sim_time = true\n{keys}'

    def options(place: int, file: Path) -> list[str]:
        return ["--ros2", "--topics", str(file)]

    return Ends("ros2", lambda: time.time_ns(), options, settings)


TRANSPORTS = {
    "zmq": Ends(
        driver="zmq",
        place=free_port,
        options=lambda port, _: ["--zmq", str(port)],
        settings=lambda port: (
            f'states = "tcp://127.0.0.1:{port}"\ncommands = "tcp://127.0.0.1:{port + 1}"\n'
            "connect_timeout = 60.0\nuse_sim_time = true\n"
        ),
    ),
    "ros2": _ros2(""),
    "ros2-trajectory": _ros2('[command]\ntype = "trajectory_msgs/JointTrajectory"\n'),
}


def start_robot(scene: str, options: Sequence[str], **pipes: Any) -> subprocess.Popen[str]:
    """Start ``faulty_robot.py``; it has the options of ``warpmpc robot`` and those of links."""
    command = [sys.executable, str(TOOLS / "shared" / "faulty_robot.py"), scene, *options]
    return subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(TOOLS)}, text=True, **pipes)


class Planner:
    """``warpmpc run --real-time`` in a separate process.

    Args:
        scene: The scene.
        robot: Driver and its file.
        speed: The robot's seconds in a second.
        options: More options.
    """

    def __init__(self, scene: str, robot: str, *, speed: float, options: list[str]):
        command = ["run", scene, "--real-time", "--robot", robot, "--speed", str(speed), "--json", *options]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen([*PROGRAM, *command], start_new_session=True, **pipes)

    def send(self, number: signal.Signals) -> None:
        """Send a signal to it and the processes that it started."""
        os.killpg(self.process.pid, number)

    def result(self, timeout: float = PATIENCE) -> dict[str, Any]:
        """What it printed, once it has ended.

        Raises:
            ValueError: If it printed no result.
        """
        out, errors = self.process.communicate(timeout=timeout)
        if not out:
            raise ValueError(f"the planner ended without a result: {errors}")
        return json.loads(out)

    def kill(self) -> None:
        """End it, if it is still there."""
        if self.process.poll() is None:
            self.send(signal.SIGKILL)
        self.process.communicate()


class Drill:
    """A robot on a long way whose messages go wrong on demand, and its planner.

    Args:
        transport: Name of the transport, of :data:`TRANSPORTS`.
        folder: Where files go.
        speed: The robot's seconds in a second.
    """

    def __init__(self, transport: str, folder: Path, *, speed: float = 1.0):
        ends = TRANSPORTS[transport]
        place = ends.place()
        self.scene, file = folder / "drill.toml", folder / f"{transport}.toml"
        self.scene.write_text(DRILL, encoding="utf-8")
        file.write_text(ends.settings(place), encoding="utf-8")
        self.robot = f"{ends.driver}:{file}"
        options = ["--orders", "--speed", str(speed), *ends.options(place, file)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "bufsize": 1}
        self._process = start_robot(str(self.scene), options, **pipes)
        self._answers: Queue[str] = Queue()
        threading.Thread(target=self._listen, daemon=True).start()
        self._speed = speed
        self.planner = self.start_planner()

    def start_planner(self) -> Planner:
        """Start a planner, the first or one more."""
        return Planner(str(self.scene), self.robot, speed=self._speed, options=["--engine", "mujoco"])

    def __enter__(self) -> Drill:
        return self

    def __exit__(self, *error: object) -> None:
        self.planner.kill()
        self._process.kill()
        self._process.wait()

    def order(self, *words: object) -> dict[str, Any]:
        """Give an order, as ``faulty_robot.py`` knows them; returns the answer.

        Raises:
            ValueError: If there is none.
        """
        self.say(*words)
        return self.answer()

    def say(self, *words: object) -> None:
        """Give an order."""
        self._process.stdin.write(" ".join(map(str, words)) + "\n")

    def answer(self) -> dict[str, Any]:
        """The next answer.

        Raises:
            ValueError: If there is none.
        """
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            try:
                return json.loads(self._answers.get(timeout=0.2))
            except Empty:
                if self.planner.process.poll() not in (None, -signal.SIGKILL):
                    raise ValueError(f"the planner ended: {self.planner.process.communicate()}") from None
                if self._process.poll() is not None:
                    raise ValueError("the robot's process ended") from None
        raise ValueError("the robot does not answer")

    def interfere(self, seconds: float) -> dict[str, Any]:
        """Command the robot besides, at full speed backwards, and by what is no number; returns the answer."""
        import numpy as np

        from warpmpc import load_scene
        from warpmpc.loop.robots.drivers import await_state, make_robot
        from warpmpc.scene.model.compiled import compile_scene

        scene = load_scene(str(self.scene))
        compiled = compile_scene(scene)
        rogue = make_robot(self.robot, scene, compiled=compiled)
        await_state(rogue, "second")
        self.order("await")
        self.say("watch", seconds)
        until = time.monotonic() + seconds / self._speed
        for number in range(10**9):
            if time.monotonic() > until:
                break
            rogue.observe()
            rogue.apply(compiled.layout.control_lower if number % 2 else np.full(compiled.layout.nu, np.nan))
            time.sleep(2e-3)
        rogue.close()
        return self.answer()

    def _listen(self) -> None:
        for line in self._process.stdout:
            if line.startswith("{"):
                self._answers.put(line)
