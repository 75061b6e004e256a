# SPDX-License-Identifier: Apache-2.0
"""A driver's robot with what a scene estimates from its measurements."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..estimation import base_estimator, pose_filter
from ..estimation.history import KEPT
from ..estimation.measurement import ImuMeasured, JointsMeasured, Measurement, PoseMeasured
from ..estimation.scene_estimator import SceneEstimator
from ..scene.schema_estimate import Sensors
from .heard import Heard

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..model.state import State
    from ..planner.plan import Plan
    from ..realtime.loop import Robot
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")

AHEAD = 0.25
"""Time by which a measurement may be ahead of the state [s]."""


@dataclass
class Source:
    """Measurements of one kind and thing."""

    heard: Heard
    """Those that came."""
    what: str
    """Name of one."""
    wrong: str
    """Fault of one that cannot be used, and the cure."""
    hold: float
    """Time for which an estimate goes on without one [s]."""
    newest: float = -np.inf
    """Time of the newest [s]."""


class EstimatedRobot:
    """A robot parts of whose state are estimated from measurements; everything else is the driver's.

    Where nothing was measured for longer than an estimate goes on without (``LONGEST`` of its filter), or an estimate
    cannot be trusted, the state's time stands still, so that the agent's watchdog sees an observation that is too old.
    A measurement that is ahead of the state by more than :data:`AHEAD`, or behind it by more than :data:`KEPT`, is
    refused. A state that goes back by more than :data:`KEPT` shows that a clock was set: everything is forgotten. An
    inertial measurement unit that was silent for as long carries no estimate forward, nor does one whose clock was
    set: before the first command the robot is where the scene begins, as while the planner starts; after it nobody
    knows where it is, the state stays old, and the run is over.

    Args:
        robot: Driver with ``measurements()``.
        scene: The scene, with what is estimated.
        compiled: The scene, compiled.

    Raises:
        SceneError: If something that is estimated does not exist or is not free.
    """

    def __init__(self, robot: Robot, scene: Scene, compiled: CompiledScene):
        measured = {"plant": scene.plant.model_copy(update={"sensor": Sensors()})}
        self._robot, self._estimator = robot, SceneEstimator(scene.model_copy(update=measured), compiled)
        self._sources: dict[tuple[str, type], Source] = {}
        for name in scene.estimate:
            wrong = "out of range or has no rotation: send x, y, z, qx, qy, qz, qw, and its time"
            heard = Heard(f"measured poses of {name}", "poses")
            self._sources[name, PoseMeasured] = Source(heard, "a pose", wrong, pose_filter.LONGEST)
        for name in scene.estimate_base:
            for kind, content in ((ImuMeasured, "inertial measurement unit"), (JointsMeasured, "joints")):
                heard = Heard(f"{content} of {name}", "measurements")
                source = Source(
                    heard, "a measurement", "not finite, out of range or of the wrong size", base_estimator.LONGEST
                )
                self._sources[name, kind] = source
        self._state: State | None = None
        self._time = self._trusted = -np.inf
        self._bases = bool(scene.estimate_base)
        self._commanded = self._lost = False
        if hasattr(robot, "follow"):
            self.follow = self._follow

    def __getattr__(self, name: str) -> Any:
        """Everything that drivers may have besides."""
        return getattr(self._robot, name)

    def heard(self) -> list[Heard]:
        """The driver's sources, and measurements of each thing that is estimated."""
        return [*getattr(self._robot, "heard", list)(), *(source.heard for source in self._sources.values())]

    def observe(self) -> State | None:
        """The newest state as it is estimated, None before everything was measured."""
        state = self._robot.observe()
        if state is None or not np.isfinite(state.time):
            return None if self._state is None else state  # the watchdog tells of it
        told = self._robot.measurements()
        silent = self._silence(told, state.time)
        if state.time < self._time - KEPT or silent is not None:
            why = (
                "the clock was set back by" if silent is None else f"the unit or joints of {silent[0]} were silent for"
            )
            if self._bases and self._commanded and not self._lost:
                self._lost = True
                logger.error("%s over %g s: where the robot is is not known; run anew", why, KEPT)
            if not self._lost:
                self._estimator.reset()
                self._state, self._time = None, state.time
                for source in self._sources.values():
                    source.newest = -np.inf
                told = told if silent is None else [measured for measured in told if measured.time >= silent[1]]
        if self._lost:
            return self._state
        for measurement in told:
            if (source := self._sources.get((measurement.name, type(measurement)))) is not None:
                self._take(source, measurement, state.time)
        until = min(source.newest + source.hold for source in self._sources.values())
        if until == -np.inf:
            return None
        if self._estimator.trusted(state.time):
            self._trusted = state.time
        until = min(until, self._trusted)
        if told or state.time != self._time:
            self._state = replace(self._estimator.fill(state), time=min(state.time, until))
        self._time = state.time
        return self._state

    @property
    def done(self) -> bool:
        """Return whether the run is over: where nobody knows where the robot is, or by the driver's own word."""
        return self._lost or bool(getattr(self._robot, "done", False))

    def apply(self, control: np.ndarray) -> None:
        """Send a control ``[nu]``."""
        self._commanded = True
        self._robot.apply(control)

    def _follow(self, plan: Plan, now: float) -> None:
        self._commanded = True
        self._robot.follow(plan, now)

    def _silence(self, told: list[Measurement], now: float) -> tuple[str, float] | None:
        """The robot whose unit was silent for too long, and when it spoke again [s]; None for none."""
        for (name, kind), source in self._sources.items():
            if kind is not ImuMeasured:
                continue
            own = [measured.time for measured in told if isinstance(measured, kind) and measured.name == name]
            known = np.sort([t for t in (source.newest, *own) if np.isfinite(t) and t <= now + AHEAD])
            gaps = np.flatnonzero(np.diff(known) > KEPT)
            if len(gaps):
                return name, float(known[gaps[-1] + 1])
        return None

    def _take(self, source: Source, measured: Measurement, now: float) -> None:
        """Take in a measurement that may be as its numbers and its time are; note it, or why it is refused."""
        heard, ahead = source.heard, measured.time - now
        if ahead > AHEAD:
            late = f"{ahead:.3f} s ahead of the robot's state: stamp both by the robot's clock"
            heard.refuse(f"{source.what} is {late}")
        elif ahead < -KEPT:
            heard.refuse(
                f"{source.what} is {-ahead:.3g} s older than the robot's state: stamp both by the robot's clock"
            )
        elif not self._estimator.update(measured):
            heard.refuse(f"{source.what} is {source.wrong}")
        else:
            source.newest = max(measured.time, source.newest)
            heard.note(source.newest)
