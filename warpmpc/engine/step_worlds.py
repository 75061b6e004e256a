# SPDX-License-Identifier: Apache-2.0
"""Worlds that take one control step, each from its own state: derivatives of an engine are their differences.

Between the states of a scene and those of its MuJoCo model, for simulators that step that model in all worlds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from ..cost.stack import CostEvaluator
from ..kernels.engine.clone import (
    clone_activation_kernel,
    clone_mocap_kernel,
    clone_state_kernel,
    gather_kernel,
    mujoco_activation_kernel,
    mujoco_state_kernel,
    record_mujoco_kernel,
)
from ..physics.runtime.launch import CapturedLaunches, Launcher, capturing
from ..physics.runtime.thread_pool import PARTS, ThreadPool
from ..scene.model.conversion import StateRows
from ..scene.model.joints import joint_table
from ..scene.model.mujoco_model import Options, make_world
from ..scene.model.trajectory import BatchSize, Trajectory

if TYPE_CHECKING:
    from ..kernels.cost.view import StepView
    from ..scene.model.layout import Layout
    from ..scene.model.mujoco_model import MujocoWorld
    from ..scene.task.observed import ObservedState
    from .protocol import EngineRequest, PhysicsSteps, Simulator


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


LEAD = 1
"""Slices of the record before the states that worlds start in: terms that ask for the control before find it there."""


class Residuals(Protocol):
    """Residuals of the terms, as :class:`warpmpc.planner.derivatives.residuals.Residuals`."""

    width: int  # R

    def launch(self, view: StepView, rollouts: int, first: int, count: int, out: wp.array) -> None:
        """Write those of some worlds after the step ``[W, R]``; capture-safe."""


class StepWorlds(ABC):
    """N worlds of every environment that take one control step, and the residuals after it.

    A state is MuJoCo's (qpos, qvel, act). Write :attr:`starts` and :attr:`applied`, :meth:`take` the step, and read
    :attr:`ends`, :attr:`diverged` and :attr:`residuals`; the arrays stay the same ones.

    Args:
        request: What the plans' engine was built for.
        worlds: N.
        residuals: Residuals of the terms.
        world: MuJoCo's model of the scene, and how it maps to the layout.
    """

    starts: wp.array2d[wp.float64]
    """States before the step, a time before each ``[W, 1+nx]``, W = E·N."""
    ends: wp.array3d[wp.float64]
    """States after the step: the last slice ``[W, N, 1+nx]``."""
    residuals: wp.array2d[float]
    """Residuals of all terms after the step ``[W, R]``."""
    parts: Sequence[tuple[int, int]]
    """First world and number of worlds of each part that a thread takes."""

    def __init__(self, request: EngineRequest, worlds: int, residuals: Residuals, world: MujocoWorld):
        envs, device = request.shape.envs, request.device
        self.shape = BatchSize(envs, worlds, 1, 1)
        self.model, self.device, self._residuals = world.model, device, residuals
        layout, costs, dt = request.costs.layout, request.costs, float(request.grid.dt[0])
        longer = replace(self.shape, horizon=LEAD + 1)
        self._whole = Trajectory.allocate(longer, layout, len(costs.pairs), device)
        evaluator = CostEvaluator(
            costs, self._whole, self._whole.control, request.state, longer, np.array([-dt, 0.0, dt])
        )
        self._view = evaluator.view
        self._state = request.state
        self.world, self.rows = world, StateRows(layout, world)
        self.residuals = wp.zeros((self.shape.worlds, residuals.width), dtype=float, device=device)
        self._on_gpu = wp.get_device(device).is_cuda

    def _bind(
        self, starts: wp.array, ends: wp.array, parts: Sequence[tuple[int, int]], pool: ThreadPool | None
    ) -> None:
        """Say where states are on the device, and who takes which worlds; a GPU takes all at once."""
        self.starts, self.ends, self.parts, self._pool = starts, ends, parts, pool

    def replays(self, sequence: Callable[[int], None]) -> list[CapturedLaunches]:
        """Launches for each of :attr:`parts`, as :meth:`run` takes them."""
        return [CapturedLaunches(partial(sequence, part), device=self.device) for part in range(len(self.parts))]

    @property
    def _recorded(self) -> Trajectory:
        later = {}
        for field in fields(Trajectory):
            array = getattr(self._whole, field.name)
            if array.ndim > 1:  # others have no slices
                shape = (array.shape[0] - LEAD, *array.shape[1:])
                # Warp takes no slice of an empty array
                later[field.name] = (
                    array[LEAD:] if array.size else wp.zeros(shape, dtype=array.dtype, device=self.device)
                )
        return replace(self._whole, **later)

    def observed(self) -> np.ndarray:
        """The observed state of every environment ``[E, nx]``."""
        state = self._state
        return self.rows(state.joint_q.numpy(), state.joint_qd.numpy(), state.act.numpy())

    @property
    def applied(self) -> wp.array:
        """The controls before and in the step ``[2, W, nu]``."""
        return self._whole.control

    @property
    def diverged(self) -> wp.array:
        """Nonzero where the physics failed ``[W]``."""
        return self._whole.diverged

    @abstractmethod
    def follow(self) -> None:
        """Take over what was observed besides the state, mocap bodies for instance; overwrites :attr:`starts`."""

    @abstractmethod
    def take(self, part: int) -> None:
        """Take the step in a part of the worlds; capture-safe."""

    def run(self, replays: Sequence[CapturedLaunches]) -> None:
        """Run one sequence of launches for each of :attr:`parts`, on all threads or on the GPU."""
        if self._pool:
            self._pool.run(replays)
            return
        with capturing:
            for replay in replays:
                if self._on_gpu:
                    replay()
                else:  # Newton's solvers copy arrays, which no recording on the CPU holds
                    replay.sequence()

    def close(self) -> None:
        """Stop the threads."""
        if self._pool:
            self._pool.close()

    def _write_residuals(self, first: int, count: int) -> None:
        self._residuals.launch(self._view, self.shape.rollouts, first, count, self.residuals)


class ConvertedWorlds(StepWorlds, MujocoModelSimulator):
    """Worlds whose states are joint coordinates as Newton has them, in single precision."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        world = make_world(request.compiled, timestep=steps.length[0], options=Options.of(request.scene.engine))
        super().__init__(request, worlds, residuals, world)
        self.trajectory, model, count = self._recorded, world.model, self.shape.worlds
        self._bind_model(world, request.costs.layout, [0], self.device)
        rows = count, 1 + model.nq + model.nv + model.na
        self._initial, self._reached = (wp.zeros(rows, dtype=wp.float64, device=self.device) for _ in range(2))

    def follow(self) -> None:
        """Take over what MuJoCo's states do not hold, such as mocap bodies."""
        self.clone(self._state)

    def take(self, part: int) -> None:
        """Take the step in a part of the worlds; capture-safe."""
        first, count = self.parts[part]
        self.read_start(self._initial, first, count)
        if self._activation.size:
            starts = self._initial.reshape((len(self._initial), 1, self._initial.shape[1]))
            inputs = [starts, self._activation, self._end, 0, first]
            self._launch(gather_kernel, (1, count), inputs, [self.trajectory.act])
        self._advance(first, count)
        self._write_state(self._reached, first, count, 1)
        self._write_residuals(first, count)

    def _bind_rows(self, threads: int) -> None:
        """Say who takes which worlds; no threads: all at once, launch by launch."""
        count = self.shape.worlds
        size = -(-count // (PARTS * threads)) if threads > 1 else count
        parts = [(first, min(size, count - first)) for first in range(0, count, size)]
        ends = self._reached.reshape((count, 1, self._reached.shape[1]))
        self._bind(self._initial, ends, parts, ThreadPool(threads, len(parts)) if threads else None)

    @abstractmethod
    def _advance(self, first: int, count: int) -> None:
        """Take the step from slice 0 of the record to slice 1, in some worlds."""


class SimulatedWorlds(ConvertedWorlds):
    """Worlds of any simulator, all of which take the step at once.

    Args:
        make: Makes the simulator.
    """

    def __init__(
        self,
        make: Callable[[EngineRequest, PhysicsSteps], Simulator],
        request: EngineRequest,
        steps: PhysicsSteps,
        worlds: int,
        residuals: Residuals,
    ):
        super().__init__(request, steps, worlds, residuals)
        self._simulator = make(*request.one_step(steps, worlds))
        self._simulator.trajectory = self.trajectory
        self._bind_rows(0)

    def follow(self) -> None:
        """Take over what MuJoCo's states do not hold, such as mocap bodies."""
        super().follow()
        self._simulator.clone(self._state)

    def _advance(self, first: int, count: int) -> None:
        """Take the step from slice 0 of the record to slice 1, in all worlds."""
        self._simulator.rollout(self.trajectory.control)
