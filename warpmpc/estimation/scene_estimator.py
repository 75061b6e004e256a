# SPDX-License-Identifier: Apache-2.0
"""Estimated state of a scene: what its estimators know in place of what is observed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .free_joints import FreeJoint
from .history import History
from .measurement import PoseMeasured
from .pose_filter import LastPose, PoseEstimate, PoseFilter

if TYPE_CHECKING:
    from ..model.layout import Layout
    from ..model.state import State
    from ..scene.schema import Scene
    from .measurement import Estimator, Measurement


class PoseEstimator:
    """Estimator of one thing from its measured poses.

    Args:
        name: The object or robot.
        joint: Its free joint.
        filter: The filter.
        start: Coordinates and velocities of the scene's start, shown before the first measurement.
    """

    def __init__(self, name: str, joint: FreeJoint, filter: PoseFilter | LastPose, start: State):
        self.name, self._joint = name, joint
        self.history: History[PoseEstimate, PoseMeasured] = History(filter)
        self._start = np.array(start.joint_q[joint.q]), np.array(start.joint_qd[joint.qd])

    def reset(self) -> None:
        """Forget every measurement."""
        self.history.reset()

    def update(self, measurement: Measurement) -> None:
        """Take in a pose of this thing that is finite."""
        ours = isinstance(measurement, PoseMeasured) and measurement.name == self.name
        if ours and np.isfinite(measurement.pose).all():
            self.history.insert(measurement)

    def fill(self, state: State) -> State:
        """The state with the pose and velocity of this thing at its time."""
        found, joint = self.history.at(float(state.time)), self._joint
        coordinates, velocities = self._start
        if found is not None:
            coordinates = joint.coordinates(found.position, found.rotation)
            velocities = joint.velocities(found.rotation, found.linear[0], found.angular[0])
        q, qd = (np.array(array, dtype=np.float32) for array in (state.joint_q, state.joint_qd))
        q[joint.q], qd[joint.qd] = coordinates, velocities
        return replace(state, joint_q=q, joint_qd=qd)


class SceneEstimator:
    """All estimators of a scene, one for each thing in ``estimate`` or with a sensor.

    Args:
        scene: The scene.
        layout: Its layout.

    Raises:
        SceneError: If something that is measured or estimated does not exist or is not free.
    """

    def __init__(self, scene: Scene, layout: Layout):
        from ..model.state import State

        start = State.start(layout)
        self.parts: tuple[Estimator, ...] = tuple(
            PoseEstimator(name, FreeJoint(layout, name, key=key), filter, start)
            for name, filter, key in (
                *((name, PoseFilter(known), f"estimate.{name}") for name, known in scene.estimate.items()),
                *(
                    (name, LastPose(), f"plant.sensor.pose.{name}")
                    for name in scene.plant.sensor.pose
                    if name not in scene.estimate
                ),
            )
        )
        """Estimators, in the order in which they fill a state."""

    def reset(self) -> None:
        """Forget every measurement."""
        for part in self.parts:
            part.reset()

    def update(self, measurement: Measurement) -> None:
        """Take in a measurement."""
        for part in self.parts:
            part.update(measurement)

    def fill(self, state: State) -> State:
        """The state with what is estimated for its time."""
        for part in self.parts:
            state = part.fill(state)
        return state
