# SPDX-License-Identifier: Apache-2.0
"""``warpmpc robot``, the simulated robot as a process of its own, and ``warpmpc check --robot``, a look at one."""

from __future__ import annotations

import json
import re
import sys
import time
from contextlib import ExitStack, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from ..scene.load import load_scene
from .interrupts import Interrupts
from .progress import Messages
from .setup import SUCCESS, RunArguments, begin, results_only, user_errors
from .terms import load_terms

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ..model.layout import Layout
    from ..robots.process import Transport
    from ..scene.schema import Scene

LISTEN = 3.0
"""Wall time for which a check listens after the first state [s]."""


def robot(
    arguments: RunArguments,
    *,
    transport: dict[str, Any],
    seed: int,
    speed: float,
    seconds: float | None,
    link: dict[str, str | float],
) -> int:
    """Be a robot until a signal or the time ends it, print the report, and return the exit code."""
    with results_only() as out, Messages(notices=True, warnings=True), Interrupts() as interrupts:
        try:
            with user_errors():
                scene = load_scene(arguments.source, overrides=arguments.overrides)
                transport_of = _transport(scene, **transport)
                connect = _linked(transport_of, seed=seed, speed=speed, **link)
                begin(scene, "cpu")
                from ..robots.process import RobotProcess

                process = RobotProcess(scene, connect, seed=seed, speed=speed, terms=load_terms(arguments.term_files))
        except KeyboardInterrupt:
            return interrupts.code
        print(f"{scene.name}: ready, {scene.agent.rate:g} Hz", file=sys.stderr, flush=True)

        def over() -> bool:
            interrupts.check()
            return seconds is not None and process.now >= seconds

        with suppress(KeyboardInterrupt):  # as a robot is switched off
            process.run(over)
        print(json.dumps(process.report().to_json(), ensure_ascii=False, allow_nan=False), file=out, flush=True)
    return SUCCESS


def listen(arguments: RunArguments, choice: str) -> int:
    """Listen to a robot, send nothing, and show what came; returns the exit code.

    Exit code 2 where no state came: a line says which source is silent or does not fit.
    """
    name = choice.partition(":")[0]
    with results_only() as out, Messages(notices=True, warnings=True), Interrupts() as interrupts, ExitStack() as stack:
        try:
            with user_errors():
                from ..robots.drivers import await_state, find_driver, make_robot

                find_driver(choice)  # before anything takes long
                scene = load_scene(arguments.source, overrides=arguments.overrides)
                begin(scene, "cpu")
                from ..model.compiled import compile_scene
                from ..scene.draw import draw_task
                from ..task.task import Task
                from .listened import Listened

                scene = draw_task(scene, 0)[0]
                compiled = compile_scene(scene)
                keys = {"seed": 0, "task": Task(scene), "watch": (), "compiled": compiled}
                driver = make_robot(choice, scene, terms=load_terms(arguments.term_files), **keys)
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


def _transport(scene: Scene, *, zmq: int | None, ros2: bool, topics: Path | None) -> Callable[[Layout], Transport]:
    """The transport that was asked for.

    Args:
        scene: The scene, parts of which whoever commands the robot estimates.
        zmq: Port of ZeroMQ, None for none.
        ros2: True where topics were asked for.
        topics: The driver's file.

    Raises:
        ValueError: If none was, or two, or it is not installed.
    """
    from ..robots.drivers import DRIVERS, read_settings

    if (zmq is not None) == ros2:
        raise ValueError("a robot needs a transport: give --zmq PORT or --ros2")
    if topics is not None and not ros2:
        raise ValueError("--topics: goes with --ros2")
    name = "ros2" if ros2 else "zmq"
    if missing := DRIVERS[name].missing:
        raise ValueError(f"--{name}: {missing}")
    if ros2:
        from ..robots.ros2.settings import Ros2Settings
        from ..robots.ros2.transport import Ros2Transport

        estimated = {"estimated": scene.estimate, "bases": scene.estimate_base}
        return partial(Ros2Transport, settings=read_settings(Ros2Settings, topics), file=topics, **estimated)
    from ..robots.zeromq import ZmqTransport

    return partial(ZmqTransport, port=zmq)


def _linked(
    connect: Callable[[Layout], Transport], *, delay: str, drop: float, reorder: float, seed: int, speed: float
) -> Callable[[Layout], Transport]:
    """The transport with the link's faults that were asked for.

    Raises:
        ValueError: If the delay is none.
    """
    number = r"(\d+(?:\.\d*)?)"
    found = re.fullmatch(rf"{number}(?:\.\.{number})?", delay)
    if found is None or float(found[2] or found[1]) < float(found[1]):
        raise ValueError(f"--delay: milliseconds, as 20 or 20..80, not '{delay}'")
    range_ = tuple(1e-3 * float(bound or found[1]) for bound in found.groups())
    if not any((*range_, drop, reorder)):
        return connect
    from ..robots.link import FaultyLink

    return lambda layout: FaultyLink(connect(layout), delay=range_, drop=drop, reorder=reorder, seed=seed, speed=speed)
