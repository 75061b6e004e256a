# SPDX-License-Identifier: Apache-2.0
"""Worlds of the engines that take one control step, each from a state of its own."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace

import warp as wp

from ..engine.mujoco_states import MujocoModelSimulator
from ..engine.request import EngineRequest, PhysicsSteps
from ..engine.thread_pool import PARTS, ThreadPool, thread_count
from ..kernels.worlds.clone import gather_kernel
from ..kernels.worlds.kinematic import kinematic_step_kernel
from ..model.batch_size import BatchSize
from ..model.mujoco_model import Options, make_world
from ..scene.errors import SceneError
from ..scene.schema import EngineName
from .residuals import Residuals
from .worlds import LEAD, StepWorlds


def _one_step(request: EngineRequest, steps: PhysicsSteps, worlds: int) -> tuple[EngineRequest, PhysicsSteps]:
    """Request and physics steps of nominal worlds that take one control step, so many of every environment."""
    shape = BatchSize(request.shape.envs, worlds, 1, 1)
    return replace(request, shape=shape, properties=None), PhysicsSteps(steps.count[:1], steps.length[:1])


class MujocoWorlds(StepWorlds):
    """Worlds of the engine ``mujoco``, in double precision; the solver starts cold in every one of them."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        from ..engine.registry import mujoco_simulator

        self._engine = engine = mujoco_simulator(*_one_step(request, steps, worlds))
        super().__init__(request, worlds, residuals, engine.world)
        engine.trajectory = self._recorded
        self._bind(engine.initial_array, engine.state_array, engine.parts, engine.pool)

    def follow(self) -> None:
        """Take over what was observed besides the state, mocap bodies for instance; overwrites :attr:`start`."""
        self._engine.clone(self._state)

    def take(self, part: int) -> None:
        """Take the step in a part of the worlds; capture-safe."""
        self._engine.read_start(self.starts, *self.parts[part])
        self._engine.rollout_part(self._engine.trajectory.control, part)
        self._write_residuals(*self.parts[part])


class FusedWorlds(StepWorlds):
    """Worlds of the engine ``fused``, in single precision."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        from ..engine.fused_simulator import FusedSimulator

        one, step = _one_step(request, steps, worlds)
        given = {"device": request.device, "own_start": True, **one.worlds(step)}
        self._simulator = simulator = FusedSimulator(one.scene, one.compiled, one.shape, **given)
        super().__init__(request, worlds, residuals, simulator.world)
        simulator.trajectory = self._recorded
        simulator.clone(self._state)
        work, nu, shape = simulator.work, request.costs.layout.nu, self.shape
        work.knots = self._whole.control[LEAD].reshape((shape.envs, worlds, 1, nu))
        threads = thread_count(request.scene.engine.threads)
        self._groups = self._split(threads)
        parts = [(first, count) for _, _, first, count in self._groups]
        ends = work.reached.reshape((shape.worlds, 1, work.reached.shape[1]))
        self._bind(work.initial, ends, parts, None if self._on_gpu else ThreadPool(threads, len(parts)))

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
        self._write_residuals(world, worlds)


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


class NewtonWorlds(ConvertedWorlds):
    """Worlds of the engine ``newton``, with any of its solvers."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        from ..engine.registry import newton_simulator

        super().__init__(request, steps, worlds, residuals)
        self._simulator = newton_simulator(*_one_step(request, steps, worlds))
        self._simulator.trajectory = self.trajectory
        self._bind_rows(0)

    def follow(self) -> None:
        """Take over what MuJoCo's states do not hold, such as mocap bodies."""
        super().follow()
        self._simulator.clone(self._state)

    def _advance(self, first: int, count: int) -> None:
        """Take the step from slice 0 of the record to slice 1, in all worlds."""
        self._simulator.rollout(self.trajectory.control)


class KinematicWorlds(ConvertedWorlds):
    """Worlds of the engine ``kinematic``."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        from ..engine.kinematic import drives

        super().__init__(request, steps, worlds, residuals)
        self._drives, self._dt = drives(request.costs.layout, self.device), float(request.grid.dt[0])
        threads = thread_count(request.scene.engine.threads)
        self._bind_rows(0 if self._on_gpu else threads)

    def _advance(self, first: int, count: int) -> None:
        """Take the step from slice 0 of the record to slice 1, in some worlds."""
        out = self.trajectory
        outputs = [out.joint_q, out.joint_qd, out.body_q, out.body_qd]
        self._launch(kinematic_step_kernel, count, [self._table, self._drives, out.control, self._dt, first], outputs)


KINDS = {
    str(EngineName.MUJOCO): MujocoWorlds,
    str(EngineName.FUSED): FusedWorlds,
    str(EngineName.NEWTON): NewtonWorlds,
    str(EngineName.KINEMATIC): KinematicWorlds,
}
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
