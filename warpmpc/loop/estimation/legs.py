# SPDX-License-Identifier: Apache-2.0
"""Feet of a robot as its joints show them, by the kinematics and dynamics of the scene's MuJoCo model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...scene.errors import SceneError
from ...scene.model.hulls import shape_hull
from ...scene.model.mujoco_model import MujocoWorld, make_world
from .base_filter import BaseState, FeetMeasured
from .free_joints import FreeJoint

if TYPE_CHECKING:
    from ...scene.model.compiled_scene import CompiledScene
    from ...scene.model.layout import Layout
    from ...scene.schema_estimate import EstimateBase
    from .measurement import JointsMeasured

ABOVE = 0.1
"""Height above a foot from which the ground is looked for [m]."""
_GROUND, _REST = 0, 5
"""Groups of geoms: those of the world, and all others."""


def one_axis_joints(layout: Layout, robot: str, *, key: str) -> np.ndarray:
    """Joints of a robot with one axis, in the layout's order ``[n]``."""
    joints = sorted(layout.entity(robot, key=key).joints)
    return np.array([j for j in joints if layout.joint_dof_dim[j].sum() == 1], dtype=int)


def imu_mount(
    compiled: CompiledScene, world: MujocoWorld, robot: str, frame: str | None, *, key: str
) -> tuple[np.ndarray, np.ndarray]:
    """Position ``[3]`` and axes ``[3, 3]`` of an inertial measurement unit in the frame of a robot's root.

    Raises:
        SceneError: If the robot has no free root, or the frame does not exist or moves against it.
    """
    layout, model = compiled.layout, world.model
    root = layout.joint_child[FreeJoint.of(layout, robot, key=key).joint]
    if frame is None:
        return np.zeros(3), np.eye(3)
    f = layout.frame(frame, key=f"{key}.frame")
    base = model.body(compiled.body_name[root]).id
    at = model.body(compiled.body_name[layout.frame_body[f]]).id if layout.frame_body[f] >= 0 else 0
    if model.body_weldid[at] != model.body_weldid[base]:
        raise SceneError(
            "the frame of an inertial measurement unit is fixed to the root", key=f"{key}.frame", found=frame
        )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    axes = data.xmat[base].reshape(3, 3).T
    turned, local = data.xmat[at].reshape(3, 3), layout.frame_pose[f].astype(float)
    own = np.zeros(9)
    mujoco.mju_quat2Mat(own, np.roll(local[3:], 1))
    position = axes @ (data.xpos[at] + turned @ local[:3] - data.xpos[base])
    return position, axes @ turned @ own.reshape(3, 3)


class Legs:
    """Legs of a robot.

    Args:
        robot: The robot.
        estimate: What the scene says of its base.
        compiled: The scene, compiled.

    Raises:
        SceneError: If the robot has no free root, a frame does not exist, or a foot has no shape that collides.
    """

    def __init__(self, robot: str, estimate: EstimateBase, compiled: CompiledScene):
        key, layout = f"estimate_base.{robot}", compiled.layout
        world = make_world(compiled, timestep=0.01)  # no step is taken
        self._model, self._data, self._estimate = world.model, mujoco.MjData(world.model), estimate
        self.position, self.axes = imu_mount(compiled, world, robot, estimate.frame, key=key)
        """Place of the inertial measurement unit in the root's frame."""
        root, joints = layout.entity(robot).joints[0], one_axis_joints(layout, robot, key=key)
        self._root_q, self._root_qd = int(world.joint_q[root]), int(world.joint_qd[root])
        self._q, self._qd = world.joint_q[joints], world.joint_qd[joints]
        frames = [layout.frame(name, key=f"{key}.feet") for name in estimate.feet]
        for name, f in zip(estimate.feet, frames, strict=True):
            if layout.frame_body[f] not in layout.entity(robot).bodies:
                raise SceneError("a foot is a frame of the robot", key=f"{key}.feet", found=name)
        self._body = [self._model.body(compiled.body_name[layout.frame_body[f]]).id for f in frames]
        self._offset = layout.frame_pose[frames, :3].astype(float)
        self._corners = [self._shape(layout, f, key=f"{key}.feet") for f in frames]
        self._jacobian = np.zeros((len(frames), 2, 3, self._model.nv))
        self._bias = np.zeros(self._model.nv)
        self._quaternion, self._hit = np.zeros(4), np.zeros(1, dtype=np.int32)
        self._model.geom_group = np.where(self._model.geom_bodyid == 0, _GROUND, _REST)
        self._seen = np.arange(6, dtype=np.uint8) == _GROUND
        mujoco.mj_forward(self._model, self._data)  # puts the world's own geoms where they are

    def _shape(self, layout: Layout, frame: int, *, key: str) -> np.ndarray:
        """Corners of what collides of a foot, from the foot's frame along its body's axes ``[m, 3]``."""
        body = layout.frame_body[frame]
        shapes = [shape for shape in layout.shapes if shape.body == body and shape.collides]
        if not shapes:
            raise SceneError("a foot has no shape that collides", key=key, found=layout.frame_name[frame])
        corners = [shape_hull(layout, shape, 0.01).corners for shape in shapes]
        return np.concatenate(corners) - layout.frame_pose[frame, :3]

    def measure(self, state: BaseState, joints: JointsMeasured) -> FeetMeasured:
        """Feet as joints show them, where the base is estimated to be.

        The force on a foot is what its leg's joints carry beyond the leg's weight: Jᵀ f = h - τ, in which accelerations
        of the leg are left out. They are a tenth of what feet carry that stand.
        """
        model, data, estimate, rotation = self._model, self._data, self._estimate, state.rotation
        mujoco.mju_mat2Quat(self._quaternion, rotation.ravel())
        q, qd = self._root_q, self._root_qd
        data.qpos[q : q + 3] = state.position - rotation @ self.position
        data.qpos[q + 3 : q + 7] = self._quaternion
        data.qvel[qd + 3 : qd + 6] = state.spin
        data.qpos[self._q], data.qvel[self._qd] = joints.q, joints.qd
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 0, self._bias)
        count = len(self._body)
        at, arm, ground = np.zeros((count, 3)), np.zeros((count, 3)), np.full(count, np.nan)
        for i, body in enumerate(self._body):
            turned = data.xmat[body].reshape(3, 3)
            at[i] = data.xpos[body] + turned @ self._offset[i]
            mujoco.mj_jac(model, data, *self._jacobian[i], at[i], body)
            arm[i] = turned @ self._corners[i][(self._corners[i] @ turned[2]).argmin()]
            eye = at[i] + arm[i] + [0.0, 0.0, ABOVE]
            depth = mujoco.mj_ray(model, data, eye, _DOWN, self._seen, 1, -1, self._hit)
            ground[i] = eye[2] - depth if depth >= 0.0 else np.nan
        jacobian, turning = self._jacobian[:, 0][:, :, self._qd], self._jacobian[:, 1][:, :, self._qd]
        gram = jacobian @ jacobian.transpose(0, 2, 1)
        carried = jacobian @ (self._bias[self._qd] - joints.effort)
        force = np.linalg.solve(gram + 1e-8 * np.eye(3), carried[:, :, None])[:, :, 0]
        gram = rotation.T @ gram @ rotation
        noise = estimate.joints
        return FeetMeasured(
            position=(at - state.position) @ rotation,
            position_covariance=noise.position**2 * gram + estimate.kinematics**2 * np.eye(3),
            velocity=jacobian @ joints.qd @ rotation,
            velocity_covariance=noise.velocity**2 * gram,
            spin=turning @ joints.qd @ rotation,
            arm=arm @ rotation,
            loaded=force[:, 2] > estimate.load,
            ground=ground,
        )


_DOWN = np.array([0.0, 0.0, -1.0])
