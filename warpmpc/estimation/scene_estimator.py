# SPDX-License-Identifier: Apache-2.0
"""Estimated state of a scene: what its estimators know in place of what is observed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..model.state import State
from .base_estimator import BaseEstimator
from .free_joints import FreeJoint
from .history import History
from .measurement import FARTHEST, PoseMeasured, plausible
from .pose_filter import LastPose, PoseEstimate, PoseFilter

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..scene.schema import Estimate, Scene
    from .measurement import Estimator, Measurement

UNIT = 0.5, 2.0
"""Least and largest norm of a measured quaternion; others are no rotations."""


class PoseEstimator:
    """Estimator of one thing from its measured poses.

    Args:
        name: The object, or robot with a free root.
        estimate: What the scene says of it; None for where it was measured last.
        scene: The scene.
        compiled: The scene, compiled.

    Raises:
        SceneError: If there is no such thing, or it is not free.
    """

    def __init__(self, name: str, estimate: Estimate | None, scene: Scene, compiled: CompiledScene):
        key = f"plant.sensor.pose.{name}" if estimate is None else f"estimate.{name}"
        self.name, self._joint = name, FreeJoint.of(compiled.layout, name, key=key)
        self.history: History[PoseEstimate, PoseMeasured]
        if estimate is None:
            self.history = History(LastPose())
        else:
            self.history = History(PoseFilter(estimate))
        start = State.start(compiled.layout)
        self._start = start.joint_q[self._joint.q], start.joint_qd[self._joint.qd]

    def reset(self) -> None:
        """Forget every measurement."""
        self.history.reset()

    def update(self, measurement: Measurement) -> bool:
        """Take in a pose of this thing, if it is plausible; return whether it was taken."""
        if not isinstance(measurement, PoseMeasured) or measurement.name != self.name:
            return False
        if not plausible(measurement, 7, {"pose": FARTHEST}):
            return False
        taken = UNIT[0] <= float(np.linalg.norm(measurement.pose[3:])) <= UNIT[1]
        if taken:
            self.history.insert(measurement)
        return taken

    def trusted(self, time: float) -> bool:
        """Return whether the estimate can be believed: the filter's gate looks at every pose."""
        return True

    def fill(self, state: State) -> State:
        """The state with the pose and velocity of this thing at its time; those of its start before a measurement."""
        found, joint = self.history.at(float(state.time)), self._joint
        coordinates, velocities = self._start
        if found is not None:
            coordinates = joint.coordinates(found.position, found.rotation)
            velocities = joint.velocities(found.rotation, found.linear[0], found.angular[0])
        q, qd = (np.array(array, dtype=np.float32) for array in (state.joint_q, state.joint_qd))
        q[joint.q], qd[joint.qd] = coordinates, velocities
        return replace(state, joint_q=q, joint_qd=qd)


class SceneEstimator:
    """All estimators of a scene, one for each thing in ``estimate``, ``estimate_base`` or with a sensor of its pose.

    Args:
        scene: The scene.
        compiled: The scene, compiled.

    Raises:
        SceneError: If something that is measured or estimated does not exist or is not free.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene):
        names = dict.fromkeys((*scene.estimate, *scene.plant.sensor.pose))
        self.parts: tuple[Estimator, ...] = (
            *(BaseEstimator(name, known, compiled) for name, known in scene.estimate_base.items()),
            *(PoseEstimator(name, scene.estimate.get(name), scene, compiled) for name in names),
        )
        """Estimators, in the order in which they fill a state."""

    def reset(self) -> None:
        """Forget every measurement."""
        for part in self.parts:
            part.reset()

    def update(self, measurement: Measurement) -> bool:
        """Take in a measurement; return whether an estimator took it."""
        return any(part.update(measurement) for part in self.parts)

    def trusted(self, time: float) -> bool:
        """Return whether everything that is estimated at a time [s] can be believed."""
        return all(part.trusted(time) for part in self.parts)

    def fill(self, state: State) -> State:
        """The state with what is estimated for its time."""
        for part in self.parts:
            state = part.fill(state)
        return state
