# SPDX-License-Identifier: Apache-2.0
"""Estimated state of a scene: what its estimators know in place of what is observed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..model.state import State
from ..scene.schema_estimate import PoseModel
from .base_estimator import BaseEstimator
from .free_joints import FreeJoint
from .history import History
from .measurement import PoseMeasured
from .physics_filter import PhysicsFilter, ThingSimulation
from .pose_filter import LastPose, PoseEstimate, PoseFilter

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..scene.schema import Estimate, Scene
    from .measurement import Estimator, Measurement


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
        self._simulation: ThingSimulation | None = None
        self.history: History[PoseEstimate, PoseMeasured]
        if estimate is None:
            self.history = History(LastPose())
        elif estimate.model is PoseModel.PHYSICS:
            self._simulation = ThingSimulation(self._joint, name, scene, compiled)
            self.history = History(PhysicsFilter(estimate, self._simulation))
        else:
            self.history = History(PoseFilter(estimate))
        start = State.start(compiled.layout)
        self._start = start.joint_q[self._joint.q], start.joint_qd[self._joint.qd]
        self._waiting: list[PoseMeasured] = []

    def reset(self) -> None:
        """Forget every measurement."""
        self.history.reset()
        self._waiting.clear()
        if self._simulation is not None:
            self._simulation.reset()

    def update(self, measurement: Measurement) -> bool:
        """Take in a pose of this thing, if its numbers are finite; return whether it was taken."""
        if not isinstance(measurement, PoseMeasured) or measurement.name != self.name:
            return False
        taken = bool(np.isfinite([measurement.time, *measurement.pose]).all() and np.any(measurement.pose[3:]))
        if taken:
            self._waiting.append(measurement)  # until it is known where the robot was then
        return taken

    def fill(self, state: State) -> State:
        """The state with the pose and velocity of this thing at its time; those of its start before a measurement."""
        if self._simulation is not None:
            self._simulation.note(state)
        for measurement in self._waiting:
            self.history.insert(measurement)
        self._waiting.clear()
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

    def fill(self, state: State) -> State:
        """The state with what is estimated for its time."""
        for part in self.parts:
            state = part.fill(state)
        return state
