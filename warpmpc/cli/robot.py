# SPDX-License-Identifier: Apache-2.0
"""``warpmpc robot``, the simulated robot as a separate process, and ``warpmpc check --robot``, a look at one.

A robot's sources and joints as tables, as a driver hears them.
"""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from ..loop.realtime.watchdog import Watchdog, received
from ..loop.robots.sources import Heard
from .describe import joint_table
from .interrupts import Interrupts
from .progress import Messages
from .setup import SUCCESS, RunArguments, begin, results_only, user_errors
from .terminal import say, say_json, screen

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ..loop.realtime.loop import Robot
    from ..loop.robots.simulated import Transport
    from ..scene.model.layout import Layout
    from ..scene.schema import Scene

LISTEN = 3.0
"""Wall time for which a check listens after the first state [s]."""


def robot(arguments: RunArguments, *, transport: dict[str, Any], seed: int, speed: float, seconds: float | None) -> int:
    """Be a robot until a signal or the time ends it, print the report, and return the exit code."""
    with results_only() as out, Messages(notices=True, warnings=True), Interrupts() as interrupts:
        try:
            with user_errors():
                scene, terms = arguments.load()
                connect = transport_of(scene, **transport)
                begin(scene, "cpu")
                from ..loop.robots.simulated import RobotProcess

                process = RobotProcess(scene, connect, seed=seed, speed=speed, terms=terms)
        except KeyboardInterrupt:
            return interrupts.code
        say(f"{scene.name}: ready, {scene.agent.rate:g} Hz", out=sys.stderr)

        def over() -> bool:
            interrupts.check()
            return seconds is not None and process.now >= seconds

        with suppress(KeyboardInterrupt):  # as a robot is switched off
            process.run(over)
        say_json(process.report().to_json(), out)
    return SUCCESS


def listen(arguments: RunArguments, choice: str) -> int:
    """Listen to a robot, send nothing, and show what came; returns the exit code.

    Exit code 2 where no state came: a line says which source is silent or does not fit.
    """
    name = choice.partition(":")[0]
    with results_only() as out, Messages(notices=True, warnings=True), Interrupts() as interrupts, ExitStack() as stack:
        try:
            with user_errors():
                from ..loop.robots.drivers import await_state, find_driver, make_robot

                find_driver(choice)  # before anything takes long
                scene, terms = arguments.load()
                begin(scene, "cpu")
                from ..scene.draw import draw_task
                from ..scene.model.compiled import compile_scene
                from ..scene.task.task import Task

                scene = draw_task(scene, 0)[0]
                compiled = compile_scene(scene)
                keys = {"seed": 0, "task": Task(scene), "watch": (), "compiled": compiled}
                driver = make_robot(choice, scene, terms=terms, **keys)
                stack.callback(getattr(driver, "close", lambda: None))
                await_state(driver, name)
                listened, until = Listened(scene, compiled.layout, driver), time.monotonic() + LISTEN
                while time.monotonic() < until:
                    listened.look()
                    interrupts.check()
                    time.sleep(1e-3)
                listened.show(out)
        except KeyboardInterrupt:
            return interrupts.code
    return SUCCESS


def transport_of(scene: Scene, *, zmq: int | None, ros2: bool, topics: Path | None) -> Callable[[Layout], Transport]:
    """The transport that was asked for.

    Args:
        scene: The scene; the program that commands the robot may estimate parts of it.
        zmq: Port of ZeroMQ, None for none.
        ros2: True where topics were asked for.
        topics: The driver's file.

    Raises:
        ValueError: If none was, or two, or it is not installed.
    """
    from ..loop.robots.drivers import read_settings
    from ..scene.registry import ROBOTS

    if (zmq is not None) == ros2:
        raise ValueError("a robot needs a transport: give --zmq PORT or --ros2")
    if topics is not None and not ros2:
        raise ValueError("--topics: goes with --ros2")
    name = "ros2" if ros2 else "zmq"
    if missing := ROBOTS[name].missing:
        raise ValueError(f"--{name}: {missing}")
    if ros2:
        from ..extras.ros2.settings import Ros2Settings
        from ..extras.ros2.simulated_node import Ros2Transport

        estimated = {"estimated": scene.estimate, "bases": scene.estimate_base}
        return partial(Ros2Transport, settings=read_settings(Ros2Settings, topics), file=topics, **estimated)
    from ..loop.robots.zeromq import ZmqTransport

    return partial(ZmqTransport, port=zmq)


WIDTH = 160
"""Width of what is printed, but on a terminal."""


class Listened:
    """States of a robot over some seconds, and what its driver heard.

    Args:
        scene: The scene.
        layout: State layout.
        robot: The robot, which has shown a state.
    """

    def __init__(self, scene: Scene, layout: Layout, robot: Robot):
        self._layout, self._robot, self._watchdog = layout, robot, Watchdog(scene, layout)
        self._states = Heard("state", "put together by the driver")
        self._begin = time.monotonic()
        self._faults: dict[str, int] = {}
        self.look()

    def look(self) -> None:
        """Take note of the state as it is now."""
        state = received(self._robot.observe())
        if state.time == self._states.stamp:
            return
        self._state = state
        self._states.note(state.time)
        if (found := self._watchdog.observation_fault(state, state.time)) is not None:
            self._faults[found[1]] = self._faults.get(found[1], 0) + 1

    def show(self, out: TextIO) -> None:
        """Print the sources, then the joints.

        Args:
            out: Where to.
        """
        console = screen(out, width=None if out.isatty() else WIDTH)
        console.print(self._sources())
        for why, count in self._faults.items():
            console.print(f"{count} × {why}")
        if np.shape(self._state.joint_q) == (self._layout.nq,):
            console.print(joint_table(self._layout, self._state.joint_q))
        console.print("nothing was sent")

    def _sources(self) -> Table:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        table.add_column("source")
        for name in ("messages", "rate [Hz]", "age [ms]", "stamp [s]"):
            table.add_column(name, justify="right", no_wrap=True)
        table.add_column("what is wrong")
        for heard in (*getattr(self._robot, "heard", list)(), self._states):
            refused = f"{heard.refused} refused: {heard.problem}" if heard.refused else ""
            rate = "" if np.isnan(heard.rate) else f"{heard.rate:.1f}"
            numbers = (rate, f"{1e3 * heard.age:.1f}", f"{heard.stamp:.3f}") if heard.count else ("", "", "")
            table.add_row(Text(heard.source), str(heard.count), *numbers, Text(heard.missing or refused))
        return table
