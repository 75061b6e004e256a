# SPDX-License-Identifier: Apache-2.0
"""``warpmpc robot``: the simulated robot as a process of its own."""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

from ..robots.drivers import DRIVERS
from ..scene.load import load_scene
from .interrupts import Interrupts
from .progress import Messages
from .setup import SUCCESS, RunArguments, begin, results_only, user_errors
from .terms import load_terms

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..robots.process import Transport


def robot(arguments: RunArguments, *, zmq: int | None, seed: int, speed: float, seconds: float | None) -> int:
    """Be a robot until a signal or the time ends it, print the report, and return the exit code."""
    with results_only() as out, Messages(notices=True, warnings=True), Interrupts() as interrupts:
        try:
            with user_errors():
                connect = _transport(zmq)
                scene = load_scene(arguments.source, overrides=arguments.overrides)
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


def _transport(zmq: int | None) -> Callable[..., Transport]:
    """The transport that was asked for.

    Raises:
        ValueError: If none was, or it is not installed.
    """
    if zmq is None:
        raise ValueError("a robot needs a transport: give --zmq PORT")
    if missing := DRIVERS["zmq"].missing:
        raise ValueError(f"--zmq: {missing}")
    from ..robots.zeromq import ZmqTransport

    return partial(ZmqTransport, port=zmq)
