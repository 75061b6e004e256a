# SPDX-License-Identifier: Apache-2.0
"""A driver's robot with what a scene estimates from its measurements."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..estimation.history import KEPT
from ..estimation.measurement import PoseMeasured
from ..estimation.pose_filter import LONGEST
from ..estimation.scene_estimator import SceneEstimator
from ..scene.schema_estimate import Sensors
from .heard import Heard

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..model.state import State
    from ..realtime.loop import Robot
    from ..scene.schema import Scene


class EstimatedRobot:
    """A robot whose measured poses are estimated from; everything else is the driver's.

    Where a pose was not measured for longer than :data:`LONGEST`, the state's time stands still, so that the agent's
    watchdog sees an observation that is too old. A pose that is ahead of the state by more is refused. A state that
    goes back by more than :data:`KEPT` tells of a clock that was set: everything is forgotten.

    Args:
        robot: Driver with ``measurements()``.
        scene: The scene.
        compiled: The scene, compiled.

    Raises:
        SceneError: If something that is estimated does not exist or is not free.
    """

    def __init__(self, robot: Robot, scene: Scene, compiled: CompiledScene):
        measured = {"plant": scene.plant.model_copy(update={"sensor": Sensors()}), "estimate_base": {}}
        self._robot, self._estimator = robot, SceneEstimator(scene.model_copy(update=measured), compiled)
        self._poses = {name: Heard(f"measured poses of {name}", "poses") for name in scene.estimate}
        self._state: State | None = None
        self._time = -np.inf
        self._newest: dict[str, float] = {}  # times of the newest poses [s]

    def __getattr__(self, name: str) -> Any:
        """Everything that drivers may have besides."""
        return getattr(self._robot, name)

    def heard(self) -> list[Heard]:
        """The driver's sources, and poses of each thing that is estimated."""
        return [*getattr(self._robot, "heard", list)(), *self._poses.values()]

    def observe(self) -> State | None:
        """The newest state as it is estimated, None before everything was measured."""
        state = self._robot.observe()
        if state is None or not np.isfinite(state.time):
            return None if self._state is None else state  # the watchdog tells of it
        if state.time < self._time - KEPT:
            self._estimator.reset()
            self._newest.clear()
            self._state = None
        told = self._robot.measurements()
        for measurement in told:
            if isinstance(measurement, PoseMeasured) and measurement.name in self._poses:
                self._take(measurement, state.time)
        if len(self._newest) < len(self._poses):
            return None
        if told or state.time != self._time:
            filled = self._estimator.fill(state)
            self._state = replace(filled, time=min(state.time, min(self._newest.values()) + LONGEST))
        self._time = state.time
        return self._state

    def _take(self, measured: PoseMeasured, now: float) -> None:
        """Take in a pose that may be as its numbers and its time are; note it, or why it is refused."""
        heard, ahead = self._poses[measured.name], measured.time - now
        if ahead > LONGEST:
            heard.refuse(f"a pose is {ahead:.3f} s ahead of the robot's state: stamp both by the robot's clock")
        elif not self._estimator.update(measured):
            heard.refuse("a pose is not finite or has no rotation: send x, y, z, qx, qy, qz, qw, and its time")
        else:
            newest = self._newest[measured.name] = max(measured.time, self._newest.get(measured.name, -np.inf))
            heard.note(newest)
