# SPDX-License-Identifier: Apache-2.0
"""Filter whose motion between measurements is MuJoCo's, and whose estimates do not lie in the robot."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..model.mujoco_model import Options, make_world
from ..model.state_rows import StateRows
from .history import KEPT
from .pose_filter import PoseEstimate, PoseFilter
from .rotation import exp, inverse, multiply, rotate

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..model.state import State
    from ..scene.schema import Estimate, Scene
    from .free_joints import FreeJoint
    from .measurement import PoseMeasured

STEP = 0.004
"""Longest step of the simulation [s]."""
PINNED = 1e4
"""Inertia that is added to all joints but the thing's, so that contact does not move them [kg, kg·m²]."""
DEEP = 5e-4
"""Depth of a contact that is left: contacts of rollouts are soft, too [m]."""
ROUNDS, SWEEPS = 4, 10
"""Rounds of finding contacts and pushing out, and sweeps over the contacts in each."""


class ThingSimulation:
    """One thing in a MuJoCo world whose other joints are where they were observed; it knows no controls.

    Obstacles that move with the task do not act.

    Args:
        joint: The thing's free joint.
        name: The thing.
        scene: The scene.
        compiled: The scene, compiled.
    """

    def __init__(self, joint: FreeJoint, name: str, scene: Scene, compiled: CompiledScene):
        options = Options.of(scene.engine, friction_combine=None)
        world = make_world(compiled, timestep=STEP, options=options, sensors=())
        model = self._model = world.model
        self._rows = StateRows(compiled.layout, world)
        self._q, self._qd = int(world.joint_q[joint.joint]), int(world.joint_qd[joint.joint])
        self._geoms = np.isin(np.arange(model.ngeom), world.geoms[name])
        others_q, others_qd = np.ones(model.nq, dtype=bool), np.ones(model.nv, dtype=bool)
        others_q[self._q : self._q + 7] = others_qd[self._qd : self._qd + 6] = False
        self._others_q, self._others_qd = np.flatnonzero(others_q), np.flatnonzero(others_qd)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        model.dof_armature[self._others_qd] = PINNED
        moved = model.body_mocapid[model.geom_bodyid] >= 0
        model.geom_contype[moved] = model.geom_conaffinity[moved] = 0
        self._data = mujoco.MjData(model)
        mujoco.mj_setConst(model, self._data)
        self.reset()

    def reset(self) -> None:
        """Forget what was observed."""
        self._times: list[float] = []
        self._seen: list[np.ndarray] = []

    def note(self, state: State) -> None:
        """Take note of an observed state, of a later time than those before."""
        time = float(state.time)
        if self._times and time <= self._times[-1]:
            return
        self._times.append(time)
        self._seen.append(self._rows(state.joint_q[None], state.joint_qd[None])[0])
        while self._times[0] < time - 2.0 * KEPT:
            del self._times[0], self._seen[0]

    def move(self, estimate: PoseEstimate, time: float) -> PoseEstimate:
        """The estimate with its pose and velocity moved on to a time [s]."""
        duration, data, model = time - estimate.time, self._data, self._model
        steps = math.ceil(duration / STEP - 1e-6)
        if steps < 1 or not self._times:
            return estimate
        self._put(estimate.position, estimate.rotation)
        data.qvel[self._qd : self._qd + 3] = estimate.linear[0]
        data.qvel[self._qd + 3 : self._qd + 6] = rotate(inverse(estimate.rotation), estimate.angular[0])
        data.qacc_warmstart[:] = 0.0
        model.opt.timestep = duration / steps
        for k in range(steps):
            q, qd = self._observed(estimate.time + k * model.opt.timestep)
            data.qpos[self._others_q], data.qvel[self._others_qd] = q[self._others_q], qd[self._others_qd]
            mujoco.mj_step(model, data)
        if not (np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()):
            mujoco.mj_resetData(model, data)
            return estimate
        position, rotation = self._pose()
        velocity = data.qvel[self._qd : self._qd + 6]
        linear, angular = velocity[:3].copy(), rotate(rotation, velocity[3:])
        return replace(estimate, position=position, rotation=rotation, linear=linear[None], angular=angular[None])

    def push_out(self, estimate: PoseEstimate) -> PoseEstimate:
        """The estimate with the likeliest pose near it at which the thing lies in nothing deeper than :data:`DEEP`.

        Each round linearizes the distances of the contacts and solves for the pose that is nearest by the covariance,
        by projected Gauss-Seidel sweeps over the contacts.
        """
        if not self._times:
            return estimate
        seen = np.r_[0:3, 6:9]
        covariance, data, model = estimate.covariance[np.ix_(seen, seen)], self._data, self._model
        position, rotation = estimate.position, estimate.rotation
        data.qpos[:] = self._observed(estimate.time)[0]
        for _ in range(ROUNDS):
            self._put(position, rotation)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            rows, wanted = self._contacts(position)
            if not wanted or max(wanted) <= 0.0:
                break
            jacobian = np.array(rows)
            spread = covariance @ jacobian.T
            coupling, force = jacobian @ spread, np.zeros(len(rows))
            for _ in range(SWEEPS):
                for i, depth in enumerate(wanted):
                    force[i] = max(0.0, force[i] + (depth - coupling[i] @ force) / coupling[i, i])
            step = spread @ force
            position, rotation = position + step[:3], multiply(exp(step[3:]), rotation)
        return replace(estimate, position=position, rotation=rotation / np.linalg.norm(rotation))

    def _contacts(self, position: np.ndarray) -> tuple[list[np.ndarray], list[float]]:
        """Change of each contact's distance with the pose ``[6]``, and how much it is to grow [m]."""
        rows, wanted = [], []
        for contact in self._data.contact:
            first, second = (self._geoms[geom] for geom in contact.geom)
            if first == second:
                continue
            normal = contact.frame[:3] if second else -contact.frame[:3]  # from the other into the thing
            rows.append(np.r_[normal, np.cross(contact.pos - position, normal)])
            wanted.append(-DEEP - contact.dist)
        return rows, wanted

    def _put(self, position: np.ndarray, rotation: np.ndarray) -> None:
        at = self._q
        self._data.qpos[at : at + 3], self._data.qpos[at + 3 : at + 7] = position, np.roll(rotation, 1)

    def _pose(self) -> tuple[np.ndarray, np.ndarray]:
        qpos, at = self._data.qpos, self._q
        return qpos[at : at + 3].copy(), np.roll(qpos[at + 3 : at + 7], -1)

    def _observed(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """All qpos and qvel at a time [s]: between two observed states, or on from the last one."""
        model, times, seen = self._model, self._times, self._seen
        i = max(bisect_right(times, time), 1)
        q, qd = seen[i - 1][: model.nq].copy(), seen[i - 1][model.nq : model.nq + model.nv]
        if i < len(times):
            qd = np.zeros(model.nv)
            mujoco.mj_differentiatePos(model, qd, times[i] - times[i - 1], q, seen[i][: model.nq])
        mujoco.mj_integratePos(model, q, qd, max(time - times[i - 1], 0.0))
        return q, qd


class PhysicsFilter(PoseFilter):
    """Error-state Kalman filter whose estimate moves as MuJoCo says, and lies in nothing after a measurement.

    The covariance is that of a nearly constant velocity, of which physics explains the most; see
    :class:`ThingSimulation`. DROP (Li et al. 2025) corrects a cube's estimated pose by a simulation of its own, too,
    in which a force pulls it; here the Kalman gain does.

    Args:
        estimate: What the scene says of it.
        simulation: The thing's simulation.
    """

    def __init__(self, estimate: Estimate, simulation: ThingSimulation):
        super().__init__(estimate)
        self.simulation = simulation

    def predict(self, estimate: PoseEstimate, time: float) -> PoseEstimate:
        """The estimate at a later time [s]."""
        if time <= estimate.time:
            return estimate
        moved = self.simulation.move(estimate, time)
        return replace(
            super().predict(estimate, time),
            position=moved.position,
            rotation=moved.rotation,
            linear=moved.linear,
            angular=moved.angular,
        )

    def correct(self, estimate: PoseEstimate, measurement: PoseMeasured) -> PoseEstimate:
        """The estimate with a measurement of its time, if the gate lets it through."""
        corrected = super().correct(estimate, measurement)
        return corrected if corrected.rejected else self.simulation.push_out(corrected)
