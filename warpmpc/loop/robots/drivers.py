# SPDX-License-Identifier: Apache-2.0
"""Drivers by their names: which there are, what they need, and how one is made.

Keys of the drivers' files.
"""

from __future__ import annotations

import importlib
import logging
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pydantic import ValidationError

from ...scene.errors import SceneError, some
from ...scene.load import read_toml
from ...scene.registry import ROBOTS
from ...scene.types import Flag, Positive, Section
from ..estimation.measurement import ImuMeasured, PoseMeasured
from ..plant.simulated import SimulatedPlant
from .estimated import EstimatedRobot

if TYPE_CHECKING:
    from collections.abc import Callable

    from ...scene.schema import Scene
    from ..realtime.loop import Robot
    from .sources import Heard

PORT = 5555
"""Port of states where none is given; commands have the next one."""


class ZmqSettings(Section):
    """Addresses of a robot behind ZeroMQ sockets."""

    states: str = f"tcp://127.0.0.1:{PORT}"
    """Address at which the robot publishes its states."""
    commands: str = f"tcp://127.0.0.1:{PORT + 1}"
    """Address at which the robot listens to commands."""
    connect_timeout: Positive = 10.0
    """Time for which the first state is waited for [s]."""
    use_sim_time: Flag = False
    """Whether the robot's clock may run slower than this host's, as that of ``warpmpc robot --speed``."""


logger = logging.getLogger("warpmpc")

FIRST_STATE = 10.0
"""Wall time for which a first state is waited for, where a driver has no ``connect_timeout`` [s]."""
POLL = 0.01
"""Wall time between two looks for it [s]."""

S = TypeVar("S", bound=Section)


@dataclass(frozen=True, kw_only=True)
class Driver:
    """A driver that is imported when it is used, and says what it needs."""

    summary: str
    """A sentence about it."""
    make: str
    """Where it is made: ``module:function``."""
    package: str | None = None
    """Python package that it needs."""
    extra: str | None = None
    """Extra of warpmpc that brings the package."""
    settings: type[Section] | None = None
    """Keys of its file; None where it takes none."""

    def __call__(self, scene: Scene, *, config: Path | None = None, **keys: object) -> Robot:
        """The robot; it is made with ``settings``, too, where it has a file.

        Raises:
            SceneError: If the file has a mistake.
            ValueError: If it takes no file.
        """
        if self.settings is None and config is not None:
            raise ValueError(f"takes no file, but was given {config}: leave it out")
        if self.settings is not None:
            keys |= {"settings": read_settings(self.settings, config), "config": config}
        module, _, name = self.make.partition(":")
        return getattr(importlib.import_module(module), name)(scene, **keys)

    @property
    def missing(self) -> str | None:
        """Sentence about what is to be installed first, None where nothing is."""
        if self.package is None or find_spec(self.package) is not None:
            return None
        return f'needs {self.package}: pip install "warpmpc[{self.extra}]"'


DRIVERS = {
    "simulated": Driver(
        summary="The scene's plant in this process; moves on by one tick with every command.",
        make="warpmpc.loop.robots.simulated:simulated_robot",
    ),
    "zmq": Driver(
        summary="States and commands as JSON through two ZeroMQ sockets.",
        make="warpmpc.loop.robots.zeromq:ZmqRobot",
        package="zmq",
        extra="transport",
        settings=ZmqSettings,
    ),
}
"""Drivers of the core; ROS 2's comes as an entry point, as those of other packages do."""


def find_driver(choice: str) -> Callable[..., Robot]:
    """The driver of a choice ``NAME`` or ``NAME:FILE.toml``.

    Raises:
        ValueError: If there is no such driver, or what it needs is not installed; says how to get it.
    """
    name = choice.partition(":")[0]
    driver = ROBOTS.find(name)
    if missing := getattr(driver, "missing", None):
        raise ValueError(f"the robot '{name}': {missing}")
    return driver


def make_robot(choice: str, scene: Scene, **keys: object) -> Robot:
    """The robot of a choice ``NAME`` or ``NAME:FILE.toml``, with what the scene estimates from its measurements.

    The log has a warning of what the scene estimates from something that the driver does not measure.

    Args:
        choice: Name of the driver, and its file.
        scene: The scene.
        keys: What the driver is given besides: ``seed``, ``task``, ``terms``, ``watch``, ``compiled``.

    Raises:
        ValueError: If there is no such driver, or it cannot be made; names the driver and the cure.
    """
    make = find_driver(choice)
    name, _, file = choice.partition(":")
    config = {"config": Path(file)} if file else {}
    try:
        robot = make(scene, **keys, **config)
    except SceneError:
        raise
    except (ValueError, OSError) as error:
        raise ValueError(f"the robot '{name}': {error}") from error
    if isinstance(robot, SimulatedPlant):
        return robot  # it estimates by itself
    unused, used = [], scene
    for key, kind in (("estimate_base", ImuMeasured), ("estimate", PoseMeasured)):
        if kind not in measured_kinds(robot):
            unused += [f"{key}.{entry}" for entry in getattr(scene, key)]
            used = used.model_copy(update={key: {}})
    if unused:
        logger.warning("%s: not used: the robot '%s' does not measure what it needs", some(unused), name)
    return EstimatedRobot(robot, used, keys["compiled"]) if used.estimate or used.estimate_base else robot


def measured_kinds(robot: Robot) -> tuple[type, ...]:
    """Kinds of a driver's measurements: poses, where it has measurements and does not say of which."""
    return getattr(robot, "measures", (PoseMeasured,) if hasattr(robot, "measurements") else ())


def read_settings(section: type[S], path: Path | None) -> S:
    """Settings of a driver from its file, the defaults without one.

    Raises:
        SceneError: If the file cannot be read or has a mistake: names the file, the key and what may stand there.
    """
    data = {} if path is None else read_toml(path)
    try:
        return section.model_validate(data)
    except ValidationError as error:
        raise SceneError.from_validation(error, data, section, file=path) from None


def await_state(robot: Robot, name: str) -> None:
    """Wait until a robot has shown its first state.

    Raises:
        ValueError: If it shows none in its ``connect_timeout``: says which source is silent or does not fit.
    """
    timeout = getattr(robot, "connect_timeout", FIRST_STATE)
    until = time.monotonic() + timeout
    while robot.observe() is None:
        if time.monotonic() > until:
            sources: list[Heard] = getattr(robot, "heard", list)()
            why = "; ".join(text for source in sources if (text := source.missing)) or "it shows no state"
            raise ValueError(f"the robot '{name}' is not there after {timeout:g} s: {why}")
        time.sleep(POLL)
