# SPDX-License-Identifier: Apache-2.0
"""A driver's robot with what a scene estimates from its measurements."""

from __future__ import annotations

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
    from ..realtime.loop import Robot
    from ..scene.schema import Scene

AHEAD = 0.25
"""Time by which a measurement may be ahead of the state [s]."""


@dataclass
class Source:
    """Measurements of one kind and thing."""

    heard: Heard
    """Those that came."""
    what: str
    """What one is called."""
    wrong: str
    """What one is that cannot be used, and the cure."""
    hold: float
    """Time for which an estimate goes on without one [s]."""
    newest: float = -np.inf
    """Time of the newest [s]."""


class EstimatedRobot:
    """A robot parts of whose state are estimated from measurements; everything else is the driver's.

    Where nothing was measured for longer than an estimate goes on without (``LONGEST`` of its filter), the state's
    time stands still, so that the agent's watchdog sees an observation that is too old. A measurement that is ahead of
    the state by more than :data:`AHEAD` is refused. A state that goes back by more than :data:`KEPT` tells of a clock
    that was set: everything is forgotten; so it is where an inertial measurement unit was silent for as long, as before
    the planner was ready.

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
            wrong = "not finite or has no rotation: send x, y, z, qx, qy, qz, qw, and its time"
            heard = Heard(f"measured poses of {name}", "poses")
            self._sources[name, PoseMeasured] = Source(heard, "a pose", wrong, pose_filter.LONGEST)
        for name in scene.estimate_base:
            for kind, content in ((ImuMeasured, "inertial measurement unit"), (JointsMeasured, "joints")):
                heard = Heard(f"{content} of {name}", "measurements")
                source = Source(heard, "a measurement", "not finite: send numbers", base_estimator.LONGEST)
                self._sources[name, kind] = source
        self._state: State | None = None
        self._time = -np.inf

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
        if state.time < self._time - KEPT or self._fell_silent(told):
            self._estimator.reset()
            self._state = None
            for source in self._sources.values():
                source.newest = -np.inf
        for measurement in told:
            if (source := self._sources.get((measurement.name, type(measurement)))) is not None:
                self._take(source, measurement, state.time)
        until = min(source.newest + source.hold for source in self._sources.values())
        if until == -np.inf:
            return None
        if told or state.time != self._time:
            self._state = replace(self._estimator.fill(state), time=min(state.time, until))
        self._time = state.time
        return self._state

    def _fell_silent(self, told: list[Measurement]) -> bool:
        """Return whether a unit speaks again that was silent for too long to carry the estimate forward."""
        for (name, kind), source in self._sources.items():
            times = [measured.time for measured in told if isinstance(measured, kind) and measured.name == name]
            if kind is ImuMeasured and times and min(times) > source.newest + KEPT > -np.inf:
                return True
        return False

    def _take(self, source: Source, measured: Measurement, now: float) -> None:
        """Take in a measurement that may be as its numbers and its time are; note it, or why it is refused."""
        heard, ahead = source.heard, measured.time - now
        if ahead > AHEAD:
            late = f"{ahead:.3f} s ahead of the robot's state: stamp both by the robot's clock"
            heard.refuse(f"{source.what} is {late}")
        elif not self._estimator.update(measured):
            heard.refuse(f"{source.what} is {source.wrong}")
        else:
            source.newest = max(measured.time, source.newest)
            heard.note(source.newest)
