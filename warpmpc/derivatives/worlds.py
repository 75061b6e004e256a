# SPDX-License-Identifier: Apache-2.0
"""Worlds that take one control step, each from a state of its own."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial

import numpy as np
import warp as wp

from ..cost.stack import Judge
from ..engine.crew import Crew
from ..engine.registry import EngineRequest, PhysicsSteps
from ..launch import Replay, capturing
from ..model.batch_size import BatchSize
from ..model.mujoco_model import MujocoWorld, Options
from ..model.rows import MujocoRows
from ..model.trajectory import Trajectory
from ..scene.errors import SceneError
from ..scene.schema import EngineName
from .residuals import Residuals

LEAD = 1
"""Slices of the record before the states that worlds start in: terms that ask for the control before find it there."""
PARTS = 4
"""Parts of the worlds per thread, as in the engines."""


class StepWorlds(ABC):
    """N worlds of every environment that take one control step, and the residuals after it.

    A state is MuJoCo's (qpos, qvel, act). Set :attr:`start`, :attr:`control` and :attr:`before`, call :meth:`step`, and
    read :attr:`end` and :attr:`residual`; the arrays stay the same ones.

    Args:
        request: What the plans' engine was built for.
        worlds: N.
        residuals: Residuals of the terms.
        world: MuJoCo's model of the scene, and how it maps to the layout.
    """

    start: np.ndarray
    """States before the step ``[W, nx]``, W = E·N."""
    end: np.ndarray
    """States after it ``[W, nx]``; infinite where the physics failed."""
    control: np.ndarray
    """Controls ``[W, nu]``."""
    before: np.ndarray
    """Controls that acted before them ``[W, nu]``."""
    residual: np.ndarray
    """Residuals of all terms after the step ``[W, R]``."""
    starts: wp.array2d[wp.float64]
    """:attr:`start` on the device, a time before each ``[W, 1+nx]``."""
    ends: wp.array3d[wp.float64]
    """:attr:`end` on the device, the last of the slices ``[W, N, 1+nx]``."""
    residuals: wp.array2d[float]
    """:attr:`residual` on the device."""
    parts: Sequence[tuple[int, int]]
    """First world and number of worlds of each part that a thread takes."""
    _crew: Crew
    _failed: np.ndarray
    _replays: list[Replay]

    def __init__(self, request: EngineRequest, worlds: int, residuals: Residuals, world: MujocoWorld):
        envs, device = request.shape.envs, request.device
        self.shape = BatchSize(envs, worlds, 1, 1)
        self.model, self.device, self._residuals = world.model, device, residuals
        layout, costs, dt = request.costs.layout, request.costs, float(request.grid.dt[0])
        longer = replace(self.shape, horizon=LEAD + 1)
        self._whole = Trajectory.allocate(longer, layout, len(costs.pairs), device)
        judge = Judge(costs, self._whole, self._whole.control, request.state, longer, np.array([-dt, 0.0, dt]))
        self._view = judge.view
        self._state = request.state
        self.world, self.rows = world, MujocoRows(layout, world)
        self.residuals = wp.zeros((self.shape.worlds, residuals.width), dtype=float, device=device)

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
        """Run one sequence of launches for each of :attr:`parts`, on all threads."""
        self._crew.run(replays)

    def step(self) -> None:
        """Take the step in all worlds."""
        self.run(self._replays)
        self.end[self._failed != 0] = np.inf

    def close(self) -> None:
        """Stop the threads."""
        self._crew.close()

    def _judge(self, first: int, count: int) -> None:
        self._residuals.launch(self._view, self.shape.rollouts, first, count, self.residuals)


class MujocoWorlds(StepWorlds):
    """Worlds of the engine ``mujoco``, in double precision; the solver starts cold in every one of them."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        from ..engine.mujoco import MujocoEngine

        scene, costs = request.scene, request.costs
        shape = BatchSize(request.shape.envs, worlds, 1, 1)
        self._engine = MujocoEngine(
            request.compiled,
            shape,
            substeps=steps.count[:1],
            timestep=steps.length[0],
            pairs=costs.pairs,
            threads=scene.engine.threads,
            options=Options.of(scene.engine),
            sensors=costs.sensors,
        )
        super().__init__(request, worlds, residuals, self._engine.world)
        self._engine.trajectory = self._recorded
        self.parts, self._crew = self._engine.parts, self._engine.crew
        self.starts, self.ends = self._engine.initial_array, self._engine.state_array
        self.start, self.end = self._engine.initial[:, 1:], self._engine.state[:, -1, 1:]
        self.before, self.control = self.applied.numpy()
        self.residual, self._failed = self.residuals.numpy(), self.diverged.numpy()
        self._replays = [Replay(partial(self.take, part)) for part in range(len(self.parts))]

    def follow(self) -> None:
        """Take over what was observed besides the state, mocap bodies for instance; overwrites :attr:`start`."""
        self._engine.clone(self._state)

    def take(self, part: int) -> None:
        """Take the step in a part of the worlds; capture-safe."""
        self._engine.record_start(*self.parts[part])
        self._engine.rollout_part(self._engine.trajectory.control, part)
        self._judge(*self.parts[part])


class FusedWorlds(StepWorlds):
    """Worlds of the engine ``fused``, in single precision."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        from ..engine.fused.simulator import FusedSimulator

        shape = BatchSize(request.shape.envs, worlds, 1, 1)
        self._simulator = simulator = FusedSimulator(
            request.scene,
            request.compiled,
            shape,
            substeps=steps.count[:1],
            timestep=steps.length[0],
            pairs=request.costs.pairs,
            device=request.device,
            own_start=True,
        )
        super().__init__(request, worlds, residuals, simulator.world)
        simulator.trajectory = self._recorded
        simulator.clone(self._state)
        work, nu = simulator.work, request.costs.layout.nu
        work.knots = self._whole.control[LEAD].reshape((shape.envs, worlds, 1, nu))
        self.starts, self.ends = work.initial, work.reached.reshape((shape.worlds, 1, work.reached.shape[1]))
        self._on_gpu = wp.get_device(self.device).is_cuda
        arrays = self.applied, work.initial, work.reached, self.residuals, self.diverged
        if self._on_gpu:
            self._device_arrays = arrays
            arrays = [wp.zeros(a.shape, dtype=a.dtype, device="cpu", pinned=True) for a in arrays]
        self._host_arrays = arrays
        controls, start, end, self.residual, self._failed = (a.numpy() for a in arrays)
        (self.before, self.control), self.start, self.end = controls, start[:, 1:], end[:, 1:]
        threads = request.scene.engine.threads or len(os.sched_getaffinity(0))
        self._groups = self._split(threads)
        self.parts = [(first, count) for _, _, first, count in self._groups]
        self._crew = Crew(threads, len(self.parts))
        self._replays = [] if self._on_gpu else [Replay(partial(self.take, part)) for part in range(len(self.parts))]

    def _split(self, threads: int) -> list[tuple[int, int, int, int]]:
        """First group of lanes, groups, first world and worlds of each part."""
        shape, lanes = self.shape, self._simulator.lanes
        if self._on_gpu:
            return [(0, shape.worlds, 0, shape.worlds)]
        groups = -(-shape.samples // lanes)
        size = groups if threads == 1 else max(1, -(-groups * shape.envs // (PARTS * threads)))
        out = []
        for e in range(shape.envs):
            for first in range(0, groups, size):
                count = min(size, groups - first)
                end = min((first + count) * lanes, shape.samples)
                out.append((e * groups + first, count, e * shape.samples + first * lanes, end - first * lanes))
        return out

    def follow(self) -> None:
        """Take over nothing: the observed arrays are read at every step."""

    def take(self, part: int) -> None:
        """Take the step in a part of the worlds; capture-safe."""
        first, groups, world, worlds = self._groups[part]
        self._simulator.launch(first, groups)
        self._judge(world, worlds)

    def run(self, replays: Sequence[Replay]) -> None:
        """Run one sequence of launches for each of :attr:`parts`, on all threads."""
        if not self._on_gpu:
            super().run(replays)
            return
        for replay in replays:
            replay.sequence()

    def step(self) -> None:
        """Take the step in all worlds."""
        if not self._on_gpu:
            super().step()
            return
        with capturing:
            for array, host in zip(self._device_arrays[:2], self._host_arrays[:2], strict=True):
                wp.copy(array, host)
            self.take(0)
            for array, host in zip(self._device_arrays[2:], self._host_arrays[2:], strict=True):
                wp.copy(host, array)
            wp.synchronize_device(self.device)
        self.end[self._failed != 0] = np.inf


KINDS = {str(EngineName.MUJOCO): MujocoWorlds, str(EngineName.FUSED): FusedWorlds}
"""Worlds by the engine that plans."""


def step_worlds(
    name: str, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals
) -> StepWorlds:
    """Worlds of the engine of a name.

    Raises:
        SceneError: If there are none of this engine.
    """
    if name not in KINDS:
        raise SceneError(
            f"planners with derivatives do not run on the engine {name}",
            key="engine.name",
            file=request.scene.path,
            found=name,
            allowed=["auto", *KINDS],
        )
    return KINDS[name](request, steps, worlds, residuals)
