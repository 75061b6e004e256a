# SPDX-License-Identifier: Apache-2.0
"""Start of a plan on the device: the observed state and the task."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from ..model.layout import Layout
    from .task import Task


@dataclass(frozen=True)
class ObservedState:
    """The observed state and the task, one row per environment; the arrays stay the same ones for good."""

    observed: wp.array  # [E] whether there is an observation to plan from
    elapsed: wp.array  # [E] time since the last plan [s]
    start: wp.array  # [E] time of the observation [s]
    joint_q: wp.array  # [E, nq]
    joint_qd: wp.array  # [E, nv]
    act: wp.array  # [E, na] activations
    mocap: wp.array  # [E, nm] transform, poses of mocap bodies
    pose: wp.array  # [E, poses] transform, of the task
    scalar: wp.array  # [E, scalars] of the task
    weight: wp.array  # [E, terms] of the task
    proposed: wp.array  # [E, n·P·nu] knots of samples that are proposed for this state, not finite for none
    last_control: wp.array  # [E, nu] control that acts when the plan begins
    body_q: wp.array  # [E, nb] transform, from the joints, for the resources of cost terms
    body_qd: wp.array  # [E, nb] spatial vector

    @cached_property
    def as_slice(self) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        """``joint_q``, ``joint_qd``, ``body_q`` and ``body_qd`` as one slice of a trajectory, ``[1, E, n]``."""
        arrays = (self.joint_q, self.joint_qd, self.body_q, self.body_qd)
        return tuple(array.reshape((1, *array.shape)) for array in arrays)

    @classmethod
    def allocate(cls, layout: Layout, task: Task, device: str, *, proposed: int = 0) -> ObservedState:
        """Arrays for the environments of a task, at the scene's start and with the task's present values.

        Args:
            layout: State layout.
            task: The task.
            device: Warp device.
            proposed: Numbers of all knots that are proposed for an environment.
        """
        envs = task.envs

        def tiled(values: np.ndarray, dtype: type = float) -> wp.array:
            rows = np.repeat(np.asarray(values, dtype=np.float32)[None], envs, axis=0)
            return wp.array(rows, dtype=dtype, device=device)

        poses, scalars = len(task.pose_name), len(task.scalar_name)
        split = 7 * poses
        return cls(
            observed=wp.full(envs, 1, dtype=int, device=device),
            elapsed=wp.zeros(envs, dtype=float, device=device),
            start=wp.zeros(envs, dtype=float, device=device),
            joint_q=tiled(layout.joint_q),
            joint_qd=tiled(layout.joint_qd),
            act=tiled(layout.act),
            mocap=tiled(layout.mocap, wp.transform),
            pose=wp.array(task.block[:, :split].reshape(envs, poses, 7), dtype=wp.transform, device=device),
            scalar=wp.array(task.block[:, split : split + scalars], dtype=float, device=device),
            weight=wp.array(task.block[:, split + scalars :], dtype=float, device=device),
            proposed=wp.full((envs, proposed), np.nan, dtype=float, device=device),
            last_control=wp.zeros((envs, layout.nu), dtype=float, device=device),
            body_q=wp.zeros((envs, layout.nb), dtype=wp.transform, device=device),
            body_qd=wp.zeros((envs, layout.nb), dtype=wp.spatial_vector, device=device),
        )
