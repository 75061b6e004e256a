# SPDX-License-Identifier: Apache-2.0
"""Worlds that take one control step, each from a state of its own: derivatives of an engine are their differences."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from ..cost.stack import CostEvaluator
from ..kernels.worlds.clone import gather_kernel
from ..launch import Replay, capturing
from ..model.batch_size import BatchSize
from ..model.mujoco_model import Options, make_world
from ..model.state_rows import StateRows
from ..model.trajectory import Trajectory
from ..thread_pool import PARTS, ThreadPool
from .mujoco_states import MujocoModelSimulator

if TYPE_CHECKING:
    from ..kernels.terms.view import StepView
    from ..model.mujoco_model import MujocoWorld
    from .protocol import Simulator
    from .request import EngineRequest, PhysicsSteps

LEAD = 1
"""Slices of the record before the states that worlds start in: terms that ask for the control before find it there."""


class Residuals(Protocol):
    """Residuals of the terms, as :class:`warpmpc.derivatives.residuals.Residuals`."""

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

    def replays(self, sequence: Callable[[int], None]) -> list[Replay]:
        """Launches for each of :attr:`parts`, as :meth:`run` takes them."""
        return [Replay(partial(sequence, part), device=self.device) for part in range(len(self.parts))]

    @property
    def _recorded(self) -> Trajectory:
        """The part of the record that is the step."""
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

    def run(self, replays: Sequence[Replay]) -> None:
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
