# SPDX-License-Identifier: Apache-2.0
"""A driver's robot with what a scene estimates from its measurements."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

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
    watchdog sees an observation that is too old.

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
        self._time = np.nan

    def __getattr__(self, name: str) -> Any:
        """Everything that drivers may have besides."""
        return getattr(self._robot, name)

    def heard(self) -> list[Heard]:
        """The driver's sources, and poses of each thing that is estimated."""
        return [*getattr(self._robot, "heard", list)(), *self._poses.values()]

    def observe(self) -> State | None:
        """The newest state as it is estimated, None before everything was measured."""
        state, told = self._robot.observe(), self._robot.measurements()
        for measurement in told:
            self._estimator.update(measurement)
            if isinstance(measurement, PoseMeasured) and measurement.name in self._poses:
                self._poses[measurement.name].note(measurement.time)
        if state is None or not all(heard.count for heard in self._poses.values()):
            return None
        if told or state.time != self._time:
            self._time = state.time
            newest = min(heard.stamp for heard in self._poses.values())
            filled = self._estimator.fill(state)
            self._state = replace(filled, time=min(state.time, newest + LONGEST))
        return self._state
