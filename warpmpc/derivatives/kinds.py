# SPDX-License-Identifier: Apache-2.0
"""Worlds of the engines that take one control step, each from a state of its own."""

from __future__ import annotations

import os
from abc import abstractmethod
from dataclasses import replace

import warp as wp

from ..engine.crew import Crew
from ..engine.request import EngineRequest, PhysicsSteps
from ..kernels.worlds.clone import (
    clone_mocap_kernel,
    clone_state_kernel,
    gather_kernel,
    mujoco_activation_kernel,
    mujoco_state_kernel,
    start_mujoco_kernel,
)
from ..kernels.worlds.kinematic import kinematic_step_kernel
from ..launch import Launcher
from ..model.batch_size import BatchSize
from ..model.joints import joint_table
from ..model.mujoco_model import Options, make_world
from ..scene.errors import SceneError
from ..scene.schema import EngineName
from .residuals import Residuals
from .worlds import LEAD, StepWorlds

PARTS = 4
"""Parts of the worlds per thread, as in the engines."""


class MujocoWorlds(StepWorlds):
    """Worlds of the engine ``mujoco``, in double precision; the solver starts cold in every one of them."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        from ..engine.mujoco import MujocoEngine

        scene, costs = request.scene, request.costs
        self._engine = engine = MujocoEngine(
            request.compiled,
            BatchSize(request.shape.envs, worlds, 1, 1),
            substeps=steps.count[:1],
            timestep=steps.length[0],
            pairs=costs.pairs,
            threads=scene.engine.threads,
            options=Options.of(scene.engine),
            sensors=costs.sensors,
        )
        super().__init__(request, worlds, residuals, engine.world)
        engine.trajectory = self._recorded
        self._bind(engine.initial_array, engine.state_array, engine.parts, engine.crew)

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
        from ..engine.fused_simulator import FusedSimulator

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
        threads = request.scene.engine.threads or len(os.sched_getaffinity(0))
        self._groups = self._split(threads)
        parts = [(first, count) for _, _, first, count in self._groups]
        ends = work.reached.reshape((shape.worlds, 1, work.reached.shape[1]))
        self._bind(work.initial, ends, parts, None if self._on_gpu else Crew(threads, len(parts)))

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


class ConvertedWorlds(StepWorlds):
    """Worlds whose states are joint coordinates as Newton has them, in single precision."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        world = make_world(request.compiled, timestep=steps.length[0], options=Options.of(request.scene.engine))
        super().__init__(request, worlds, residuals, world)
        self._launch, self._out = Launcher(self.device), self._recorded
        model, layout, count = world.model, request.costs.layout, self.shape.worlds
        self._nq, width = model.nq, 1 + model.nq + model.nv + model.na
        self._initial = wp.zeros((count, width), dtype=wp.float64, device=self.device)
        self._reached = wp.zeros((count, width), dtype=wp.float64, device=self.device)
        self._table = joint_table(layout, self.device, worlds=count, mujoco_q=world.joint_q, mujoco_qd=world.joint_qd)
        self._activation = wp.array(1 + model.nq + model.nv + world.activation, dtype=int, device=self.device)
        self._only = wp.zeros(1, dtype=int, device=self.device)

    def follow(self) -> None:
        """Take over what MuJoCo's states do not hold, such as mocap bodies."""
        state, out, worlds, rollouts = self._state, self._out, self.shape.worlds, self.shape.rollouts
        if mocap := state.mocap.shape[1]:
            inputs = [state.mocap, rollouts, 0]
            self._launch(clone_mocap_kernel, (worlds, mocap), inputs, [self._table.mocap_pose])
        inputs = [self._table, state.joint_q, state.joint_qd, rollouts, 0]
        self._launch(clone_state_kernel, worlds, inputs, [out.joint_q, out.joint_qd, out.body_q, out.body_qd])

    def take(self, part: int) -> None:
        """Take the step in a part of the worlds; capture-safe."""
        first, count = self.parts[part]
        out, rows = self._out, (self.shape.worlds, 1, self._initial.shape[1])
        inputs = [self._table, self._nq, self._initial.reshape(rows), first]
        self._launch(start_mujoco_kernel, count, inputs, [out.joint_q, out.joint_qd, out.body_q, out.body_qd])
        if self._activation.size:
            inputs = [self._initial.reshape(rows), self._activation, self._only, 0, first]
            self._launch(gather_kernel, (1, count), inputs, [out.act])
        self._advance(first, count)
        after = [array[1:] for array in (out.joint_q, out.joint_qd)]
        self._launch(mujoco_state_kernel, count, [self._table, self._nq, *after, first], [self._reached])
        if self._activation.size:
            dim = (count, self._activation.size)
            self._launch(mujoco_activation_kernel, dim, [out.act[1:], self._activation, first], [self._reached])
        self._judge(first, count)

    def _bind_rows(self, threads: int) -> None:
        """Say who takes which worlds; no threads: all at once, launch by launch."""
        count = self.shape.worlds
        size = -(-count // (PARTS * threads)) if threads > 1 else count
        parts = [(first, min(size, count - first)) for first in range(0, count, size)]
        ends = self._reached.reshape((count, 1, self._reached.shape[1]))
        self._bind(self._initial, ends, parts, Crew(threads, len(parts)) if threads else None)

    @abstractmethod
    def _advance(self, first: int, count: int) -> None:
        """Take the step from slice 0 of the record to slice 1, in some worlds."""


class NewtonWorlds(ConvertedWorlds):
    """Worlds of the engine ``newton``, with any of its solvers."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        from ..engine.registry import newton_simulator

        super().__init__(request, steps, worlds, residuals)
        one = PhysicsSteps(steps.count[:1], steps.length[:1])
        self._simulator = newton_simulator(replace(request, shape=self.shape, properties=None), one)
        self._simulator.trajectory = self._out
        self._bind_rows(0)

    def follow(self) -> None:
        """Take over what MuJoCo's states do not hold, such as mocap bodies."""
        super().follow()
        self._simulator.clone(self._state)

    def _advance(self, first: int, count: int) -> None:
        """Take the step from slice 0 of the record to slice 1, in all worlds."""
        self._simulator.rollout(self._out.control)


class KinematicWorlds(ConvertedWorlds):
    """Worlds of the engine ``kinematic``."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        from ..engine.kinematic import drives

        super().__init__(request, steps, worlds, residuals)
        self._drives, self._dt = drives(request.costs.layout, self.device), float(request.grid.dt[0])
        threads = request.scene.engine.threads or len(os.sched_getaffinity(0))
        self._bind_rows(0 if self._on_gpu else threads)

    def _advance(self, first: int, count: int) -> None:
        """Take the step from slice 0 of the record to slice 1, in some worlds."""
        out = self._out
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
