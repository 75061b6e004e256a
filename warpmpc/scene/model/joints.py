# SPDX-License-Identifier: Apache-2.0
"""The joint table of a layout on a device, and the chains of joints that move its bodies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...kernels.geometry.jacobian import Chain
from ...kernels.geometry.kinematics import BALL, JointTable
from .layout import IDENTITY

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .layout import Layout


def joint_table(
    layout: Layout,
    device: str,
    *,
    worlds: int = 1,
    mujoco_q: np.ndarray | None = None,
    mujoco_qd: np.ndarray | None = None,
) -> JointTable:
    """Upload a layout's joints.

    Args:
        layout: State layout.
        device: Warp device.
        worlds: Number of worlds, each with its own mocap bodies.
        mujoco_q: First qpos of each joint [nj], -1 where MuJoCo has none.
        mujoco_qd: First qvel of each joint [nj].
    """
    missing = np.full(len(layout.joint_type), -1, dtype=np.int32)

    def ints(values: np.ndarray | None) -> wp.array:
        return wp.array(missing if values is None else values, dtype=int, device=device)

    table = JointTable()
    table.type = ints(layout.joint_type)
    table.parent = ints(layout.joint_parent)
    table.child = ints(layout.joint_child)
    table.q_start = ints(layout.joint_q_start)
    table.qd_start = ints(layout.joint_qd_start)
    table.linear_axes = ints(np.ascontiguousarray(layout.joint_dof_dim[:, 0]))
    table.angular_axes = ints(np.ascontiguousarray(layout.joint_dof_dim[:, 1]))
    table.pose_parent = wp.array(layout.joint_pose_parent, dtype=wp.transform, device=device)
    table.pose_child = wp.array(layout.joint_pose_child, dtype=wp.transform, device=device)
    table.centred = ints(np.all(layout.joint_pose_child == IDENTITY, axis=1).astype(np.int32))
    table.axis = wp.array(layout.dof_axis, dtype=wp.vec3, device=device)
    table.body_com = wp.array(layout.body_com, dtype=wp.vec3, device=device)
    table.mujoco_q = ints(mujoco_q)
    table.mujoco_qd = ints(mujoco_qd)
    order = {int(body): i for i, body in enumerate(layout.mocap_body)}
    table.mocap = ints(np.array([order.get(int(child), -1) for child in layout.joint_child], dtype=np.int32))
    table.mocap_pose = start_mocap(layout, worlds, device)
    return table


def start_mocap(layout: Layout, rows: int, device: str) -> wp.array:
    """Poses of a scene's mocap bodies at the start, ``[rows, nm]``."""
    poses = wp.zeros((rows, layout.nm), dtype=wp.transform, device=device)
    if layout.nm:
        poses.assign(np.tile(layout.mocap, (rows, 1, 1)))
    return poses


def chain_axes(layout: Layout, body: int) -> list[int]:
    """Joint velocities that move a body, tip first; those of a free root, which nothing drives, are left out.

    Raises:
        ValueError: If there is a ball joint among the joints: its velocities are no turns about its own axes.
    """
    joint_of = {int(child): joint for joint, child in enumerate(layout.joint_child)}
    dofs: list[int] = []
    while body >= 0:
        joint = joint_of[body]
        first = int(layout.joint_qd_start[joint])
        own = list(range(first, first + int(layout.joint_dof_dim[joint].sum())))
        if layout.joint_type[joint] == BALL:
            raise ValueError(layout.joint_name[joint])
        dofs += [dof for dof in reversed(own) if layout.dof_coord[dof] >= 0]
        body = int(layout.joint_parent[joint])
    return dofs


def chain(layout: Layout, body: int, columns: Sequence[int], device: str) -> Chain:
    """Upload the joint axes that move a body.

    Args:
        layout: State layout.
        body: The body.
        columns: Joint velocities that are columns of its Jacobian, in this order.
        device: Warp device.

    Raises:
        ValueError: As :func:`chain_axes`, and if a column is no axis of the chain.
    """
    dofs = chain_axes(layout, body)
    ends = layout.joint_qd_start + layout.joint_dof_dim.sum(axis=1)
    joint = [int(np.flatnonzero((layout.joint_qd_start <= dof) & (dof < ends))[0]) for dof in dofs]
    slides = layout.joint_qd_start[joint] + layout.joint_dof_dim[joint, 0]

    def ints(values: object) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.int32), dtype=int, device=device)

    out = Chain()
    out.column = ints([dofs.index(dof) for dof in columns])
    out.coord = ints(layout.dof_coord[dofs])
    out.turns = ints(dofs >= slides)
    out.after = ints(ends[joint] - 1 - dofs)
    out.axis = wp.array(layout.dof_axis[dofs], dtype=wp.vec3, device=device)
    out.body = ints(layout.joint_child[joint])
    out.anchor = wp.array(layout.joint_pose_child[joint], dtype=wp.transform, device=device)
    return out


def driving(layout: Layout, dofs: np.ndarray, mode: str) -> np.ndarray:
    """Control that is what a joint shall do, or -1, for each degree of freedom ``[n]``.

    Args:
        layout: State layout.
        dofs: Degrees of freedom ``[n]``.
        mode: What the control shall be: ``position``, ``velocity`` or ``acceleration``.
    """
    out = np.full(len(dofs), -1)
    for dof, own, row in zip(layout.actuator_dof, layout.actuator_mode, layout.actuator_matrix, strict=True):
        if own == mode and np.count_nonzero(row) == 1 and row.max() == 1.0:
            out[dofs == dof] = int(row.argmax())
    return out
