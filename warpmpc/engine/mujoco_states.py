# SPDX-License-Identifier: Apache-2.0
"""Between the states of a scene and those of its MuJoCo model, for simulators that step that model in all worlds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from ..kernels.worlds.clone import (
    clone_activation_kernel,
    clone_mocap_kernel,
    clone_state_kernel,
    gather_kernel,
    mujoco_activation_kernel,
    mujoco_state_kernel,
    record_mujoco_kernel,
)
from ..launch import Launcher
from ..model.joints import joint_table

if TYPE_CHECKING:
    from ..model.batch_size import BatchSize
    from ..model.layout import Layout
    from ..model.mujoco_model import MujocoWorld
    from ..model.trajectory import Trajectory
    from ..task.observed import ObservedState


class MujocoModelSimulator:
    """Worlds that start in an observed state, and their record; MuJoCo's states are rows (time, qpos, qvel, act)."""

    shape: BatchSize
    trajectory: Trajectory

    def _bind_model(self, world: MujocoWorld, layout: Layout, end: object, device: str) -> None:
        """Make the tables.

        Args:
            world: The model.
            layout: Layout of the scene.
            end: Row of the states that each step ends in ``[T]``.
            device: Warp device.
        """
        model, worlds = world.model, self.shape.worlds

        def upload(values: object, dtype: type = int) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        self._launch, self._nq = Launcher(device), model.nq
        self._table = joint_table(layout, device, worlds=worlds, mujoco_q=world.joint_q, mujoco_qd=world.joint_qd)
        self._matrix, self._offset = upload(world.actuator_matrix, float), upload(world.actuator_offset, float)
        self._activation = upload(1 + model.nq + model.nv + world.activation)
        self._mocap, self._movable, self._sensors = upload(world.mocap), upload(world.movable), upload(world.sensor)
        self._senses = bool((world.sensor >= 0).any())
        self._obstacle_pose = wp.zeros((worlds, len(world.movable)), dtype=wp.transform, device=device)
        self._end, self._zero = upload(end), upload([0])

    def clone(self, state: ObservedState, first: int = 0, count: int | None = None) -> None:
        """Put worlds into the observed state; warm starts and forces of earlier plans are gone with it.

        Args:
            state: The observed state.
            first: First of the worlds.
            count: How many they are, all from the first on if None.
        """
        count = self.shape.worlds - first if count is None else count
        out, rollouts = self.trajectory, self.shape.rollouts
        moved = [(self._mocap, state.mocap, self._table.mocap_pose)] if self._mocap.size else []
        if self._movable.size:  # the last poses of the task
            wanted = state.pose[:, state.pose.shape[1] - self._movable.size :]
            moved.append((self._movable, wanted, self._obstacle_pose))
        for order, wanted, poses in moved:
            self._launch(clone_mocap_kernel, (count, order.size), [wanted, rollouts, first], [poses])
            self._write_mocap(poses, order, first, count)
        inputs = [self._table, state.joint_q, state.joint_qd, rollouts, first]
        self._launch(clone_state_kernel, count, inputs, [out.joint_q, out.joint_qd, out.body_q, out.body_qd])
        if self._activation.size:
            self._launch(
                clone_activation_kernel, (count, self._activation.size), [state.act, rollouts, first], [out.act]
            )

    def _write_mocap(self, poses: wp.array, order: wp.array, first: int, count: int) -> None:
        """Put mocap bodies, which ``order`` names, at poses ``[W, n]`` where the simulator has them besides."""

    def read_start(self, rows: wp.array, first: int, count: int) -> None:
        """Take states ``[W, 1+nx]`` for slice 0 of the record of some worlds; capture-safe."""
        out, starts = self.trajectory, rows.reshape((rows.shape[0], 1, rows.shape[1]))
        outputs = [out.joint_q, out.joint_qd, out.body_q, out.body_qd]
        inputs = [self._table, self._nq, self._zero, starts, 0, first, 1]
        self._launch(record_mujoco_kernel, (1, count), inputs, outputs)

    def _write_state(self, rows: wp.array, first: int, count: int, t: int = 0) -> None:
        """Write slice t of the record of some worlds into rows ``[W, 1+nx]``."""
        out = self.trajectory
        inputs = [self._table, self._nq, out.joint_q[t:], out.joint_qd[t:], first]
        self._launch(mujoco_state_kernel, count, inputs, [rows])
        if self._activation.size:
            dim = (count, self._activation.size)
            self._launch(mujoco_activation_kernel, dim, [out.act[t:], self._activation, first], [rows])

    def _record_rows(self, rows: wp.array, sensor: wp.array, first: int, count: int, lanes: int) -> None:
        """Record some worlds.

        Args:
            rows: MuJoCo's states ``[W, steps, 1+nx]``.
            sensor: Sensor values ``[W, steps, ns]``.
            first: First of the worlds.
            count: How many they are.
            lanes: Threads that share the steps of a world.
        """
        out, dim = self.trajectory, (self.shape.horizon, count)
        inputs = [self._table, self._nq, self._end, rows, 1, first, lanes]
        outputs = [out.joint_q, out.joint_qd, out.body_q, out.body_qd]
        self._launch(record_mujoco_kernel, (lanes, count), inputs, outputs)
        if self._activation.size:
            self._launch(gather_kernel, dim, [rows, self._activation, self._end, 1, first], [out.act])
        if self._senses:
            self._launch(gather_kernel, dim, [sensor, self._sensors, self._end, 0, first], [out.sensor])
