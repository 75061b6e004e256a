# SPDX-License-Identifier: Apache-2.0
"""The engine ``fused``: rollouts of MuJoCo's physics in one launch, with worlds in the lanes of a register."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from ...bake.number import native_lanes
from ...compiling import compile_kernel
from ...kernels.worlds.clone import (
    clone_activation_kernel,
    clone_mocap_kernel,
    clone_state_kernel,
    mujoco_activation_kernel,
    mujoco_state_kernel,
)
from ...launch import Launcher, Replay
from ...model.joints import joint_table
from ...model.mujoco_model import MujocoWorld, Options, make_world
from ...model.pairs import Pair
from ...model.randomize import batched_arrays
from ...model.trajectory import Trajectory
from ...scene.errors import SceneError
from ..crew import Crew
from .kernel import WARP, FusedWork, make_kernel
from .model import PhysicsModel, missing
from .source import RolloutSource, Watch

if TYPE_CHECKING:
    from ...model.batch_size import BatchSize
    from ...model.compiled import CompiledScene
    from ...model.layout import Layout
    from ...model.properties import Properties
    from ...scene.schema import Scene
    from ...task.observed import ObservedState

MOST_SHARED = 4096
"""Worlds up to which a warp shares one on a GPU; with more there are threads enough for one each."""
PARTS = 4
"""Parts of the worlds per thread, as in the engine ``mujoco``."""


class FusedSimulator:
    """Rolls controls out in a kernel that is compiled for the scene's model.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        shape: Environments, samples, domains and horizon.
        substeps: Physics steps in each control step ``[T]``.
        timestep: Length of a physics step [s].
        pairs: Pairs of entities whose contact force is watched.
        properties: Draws of physical properties; ``None`` leaves every world nominal.
        device: Warp device.

    Raises:
        SceneError: If the scene's model has what this engine lacks.
    """

    name = "fused"

    def __init__(
        self,
        scene: Scene,
        compiled: CompiledScene,
        shape: BatchSize,
        *,
        substeps: Sequence[int],
        timestep: float,
        pairs: tuple[Pair, ...] = (),
        properties: Properties | None = None,
        device: str = "cpu",
    ):
        self.shape, self.pairs, self.device = shape, pairs, device
        world = make_world(compiled, timestep=timestep, pairs=pairs, options=Options.of(scene.engine), sensors=())
        refuse(scene, world)
        self.world = world
        self._on_gpu = wp.get_device(device).is_cuda
        self._launch = Launcher(device)
        self.lanes = 1 if self._on_gpu else native_lanes()
        self.threads = 1 if self._on_gpu else scene.engine.threads or len(os.sched_getaffinity(0))
        self.parts = [(0, shape.worlds)] if self._on_gpu else _split(shape, self.threads, self.lanes)
        """First world and number of worlds of each part that a thread takes."""
        self._crew = Crew(self.threads, len(self.parts))
        arrays = batched_arrays(world, properties, shape) if properties is not None and properties.names else {}
        self.model = PhysicsModel(world.model, arrays)
        self.trajectory = Trajectory.allocate(shape, compiled.layout, len(pairs), device)
        self._sharing = WARP if self._on_gpu and shape.worlds <= MOST_SHARED else 1
        self._kernel = make_kernel(self._source(compiled), native_lanes(), self._sharing)
        compile_kernel(self._kernel, device, WARP, f"the physics of {scene.name}")
        self._bind(compiled.layout, world, substeps)

    def _source(self, compiled: CompiledScene) -> str:
        world = self.world
        return RolloutSource(
            model=self.model,
            layout=compiled.layout,
            joint_q=world.joint_q,
            joint_qd=world.joint_qd,
            bodies=[world.model.body(name).id for name in compiled.body_name],
            matrix=world.actuator_matrix,
            offset=world.actuator_offset,
            mocap=world.mocap,
            movable=world.movable,
            watched=watched(self.model, world),
            lanes=native_lanes(),
            shared=self._sharing > 1,
            activations=world.activation.tolist(),
        ).write()

    def _bind(self, layout: Layout, world: MujocoWorld, substeps: Sequence[int]) -> None:
        shape, device, out = self.shape, self.device, self.trajectory
        self._nq = world.model.nq
        self._table = joint_table(layout, device, worlds=shape.worlds, mujoco_q=world.joint_q, mujoco_qd=world.joint_qd)
        columns = self.model.columns.values
        par = np.zeros((max(1, len(columns)), shape.worlds), dtype=np.float32)
        for row, values in zip(par, columns, strict=False):
            row[:] = values
        nstate = 1 + world.model.nq + world.model.nv + world.model.na
        self._activation = wp.array(nstate - world.model.na + world.activation, dtype=int, device=device)
        work = FusedWork()
        work.initial = wp.zeros((shape.worlds, nstate), dtype=wp.float64, device=device)
        work.mocap = self._table.mocap_pose
        work.movable = wp.zeros((shape.worlds, len(world.movable)), dtype=wp.transform, device=device)
        work.substeps = wp.array(list(substeps), dtype=int, device=device)
        work.given = wp.array(self.model.given, dtype=float, device=device)
        work.par = wp.array(par, dtype=float, device=device)
        work.joint_q, work.joint_qd = out.joint_q, out.joint_qd
        work.body_q, work.body_qd, work.act = out.body_q, out.body_qd, out.act
        work.force, work.diverged, work.overflow = out.contact_force, out.diverged, out.overflow
        self._work = work

    def clone(self, state: ObservedState, first: int = 0, count: int | None = None) -> None:
        """Put worlds into the observed state; nothing of an earlier plan remains.

        Args:
            state: The observed state.
            first: First of the worlds.
            count: How many they are, all from the first on if None.
        """
        count = self.shape.worlds - first if count is None else count
        out, work, rollouts = self.trajectory, self._work, self.shape.rollouts
        if work.mocap.shape[1]:
            inputs = [state.mocap, rollouts, first]
            self._launch(clone_mocap_kernel, (count, work.mocap.shape[1]), inputs, [work.mocap])
        movable = work.movable.shape[1]
        if movable:
            poses = state.pose[:, state.pose.shape[1] - movable :]
            self._launch(clone_mocap_kernel, (count, movable), [poses, rollouts, first], [work.movable])
        inputs = [self._table, state.joint_q, state.joint_qd, rollouts, first]
        self._launch(clone_state_kernel, count, inputs, [out.joint_q, out.joint_qd, out.body_q, out.body_qd])
        inputs = [self._table, self._nq, out.joint_q, out.joint_qd, first]
        self._launch(mujoco_state_kernel, count, inputs, [work.initial])
        if self._activation.size:
            dim = (count, self._activation.size)
            self._launch(clone_activation_kernel, dim, [state.act, rollouts, first], [out.act])
            self._launch(mujoco_activation_kernel, dim, [out.act, self._activation, first], [work.initial])

    def run(self, replays: Sequence[Replay]) -> None:
        """Run one sequence of launches for each of :attr:`parts`, on all threads."""
        self._crew.run(replays)

    def rollout(self, control: wp.array) -> None:
        """Roll controls [T, W, nu] of all worlds out from the cloned state into :attr:`trajectory`, on this thread."""
        for part in range(len(self.parts)):
            self.rollout_part(control, part)

    def rollout_part(self, control: wp.array, part: int) -> None:
        """Roll controls [T, W, nu] of the worlds of one part out."""
        first, count = self.parts[part]
        self._work.control = control
        threads = self._sharing * -(-count // self.lanes)
        self._launch(self._kernel, threads, [self._work, first, first + count], [], threads=WARP)

    def overflow_message(self, bits: int) -> str:
        """What overflowed."""
        return "more contacts at once than the engine fused has room for: try the engine mujoco"

    def close(self) -> None:
        """Stop the threads."""
        self._crew.close()


def _split(shape: BatchSize, threads: int, lanes: int) -> list[tuple[int, int]]:
    """First world and number of worlds of each part: whole groups of lanes, and all domains of a sample."""
    step = int(np.lcm(lanes, shape.domains))
    groups = -(-shape.worlds // step)
    size = (groups if threads == 1 else max(1, -(-groups // (PARTS * threads)))) * step
    return [(first, min(size, shape.worlds - first)) for first in range(0, shape.worlds, size)]


def refuse(scene: Scene, world: MujocoWorld) -> None:
    """What a scene has and this engine lacks is an error.

    Raises:
        SceneError: If there is such a thing.
    """
    lack = missing(world.model)
    if lack:
        raise SceneError(
            f"the engine fused has no {lack}", key="engine.name", file=scene.path, allowed=["auto", "mujoco", "newton"]
        )


def watched(model: PhysicsModel, world: MujocoWorld) -> list[Watch]:
    """Pairs of geoms whose forces count towards the watched pairs of entities, by the model's contact sensors."""
    m, out = world.model, []
    first = m.nsensor - int(world.pair_sensor[-1])
    for index, (start, end) in enumerate(zip(world.pair_sensor[:-1], world.pair_sensor[1:], strict=True)):
        for sensor in range(first + start, first + end):
            one = _geoms(m, int(m.sensor_objtype[sensor]), int(m.sensor_objid[sensor]))
            other = _geoms(m, int(m.sensor_reftype[sensor]), int(m.sensor_refid[sensor]))
            for n, pair in enumerate(model.pairs):
                a, b = pair.geoms
                if a in one and b in other:
                    out.append(Watch(n, index, -1.0))
                elif b in one and a in other:
                    out.append(Watch(n, index, 1.0))
    return out


def _geoms(m: mujoco.MjModel, kind: int, index: int) -> set[int]:
    """Geoms of what a contact sensor looks at: a geom, a body, or a body with all that hangs on it."""
    if kind == int(mujoco.mjtObj.mjOBJ_GEOM):
        return {index}
    bodies = {index}
    if kind == int(mujoco.mjtObj.mjOBJ_XBODY):
        for body in range(index + 1, m.nbody):
            if int(m.body_parentid[body]) in bodies:
                bodies.add(body)
    return set(np.flatnonzero(np.isin(m.geom_bodyid, list(bodies))).tolist())
