# SPDX-License-Identifier: Apache-2.0
"""Base of worlds that take one control step, each from a state of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..cost.stack import CostEvaluator
from ..engine.thread_pool import ThreadPool
from ..launch import Replay, capturing
from ..model.batch_size import BatchSize
from ..model.state_rows import StateRows
from ..model.trajectory import Trajectory

if TYPE_CHECKING:
    from ..engine.request import EngineRequest
    from ..model.mujoco_model import MujocoWorld
    from .residuals import Residuals

LEAD = 1
"""Slices of the record before the states that worlds start in: terms that ask for the control before find it there."""


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
        """Take over what was observed besides the state, mocap bodies for instance; overwrites :attr:`start`."""

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
