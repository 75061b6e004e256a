# SPDX-License-Identifier: Apache-2.0
"""The physics of a scene in the engine ``fused``: its model, its source, and rollouts of given controls."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..bake.lines import OutOfRange
from ..bake.simd import native_lanes
from ..compiling import compile_kernel
from ..kernels.worlds.launch import TAPS
from ..launch import Launcher
from ..model.mujoco_model import Options, make_world
from ..model.pairs import Pair
from ..model.randomize import batched_arrays
from ..model.trajectory import Trajectory
from ..physics.batch import shares
from ..physics.kernel import WARP, RolloutWork, make_kernel
from ..physics.missing import missing, tell_differences
from ..physics.model import PhysicsModel
from ..physics.source import RolloutSource
from ..physics.steps import Steps
from ..physics.tables import packed
from ..scene.errors import SceneError
from .fused_map import state_map
from .fused_precision import refusal
from .redraw import RedrawnColumns

if TYPE_CHECKING:
    from ..model.batch_size import BatchSize
    from ..model.compiled import CompiledScene
    from ..model.properties import Properties
    from ..physics.parts import AddedCode
    from ..scene.schema import Scene
    from ..task.observed import ObservedState


class FusedPhysics:
    """The worlds of a scene.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        shape: Environments, samples, domains and horizon.
        substeps: Physics steps in each control step ``[T]``.
        timestep: Length of a physics step [s].
        pairs: Pairs of entities whose contact force is watched.
        properties: Draws of physical properties; ``None`` leaves every world nominal.
        device: Warp device.
        own_start: Whether every world starts in a state of its own, in ``initial`` of :attr:`work`.

    Raises:
        SceneError: If the scene's model has what this engine lacks.
    """

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
        own_start: bool = False,
    ):
        self.shape, self.pairs, self.device = shape, pairs, device
        world = make_world(compiled, timestep=timestep, pairs=pairs, options=Options.of(scene.engine), sensors=())
        if lack := missing(world.model):
            allowed = ["auto", "mujoco", "newton"]
            raise SceneError(f"the engine fused has no {lack}", key="engine.name", file=scene.path, allowed=allowed)
        tell_differences(world.model)
        self.world, self.layout = world, compiled.layout
        on_gpu = wp.get_device(device).is_cuda
        self.sharing = WARP if on_gpu and shares(world.model, shape.worlds) else 1
        """Threads that share a world."""
        self.lanes = 1 if on_gpu else native_lanes()
        """Worlds that a thread takes at once."""
        self._launch = Launcher(device)
        self.redraw: RedrawnColumns | None = None
        """Draws the worlds' properties anew, None where they stay; capture-safe after :meth:`fill`."""
        arrays = {}
        if properties is not None and properties.redrawn:
            self.redraw = RedrawnColumns(world, properties, shape, device)
            arrays = self.redraw.arrays
        elif properties is not None and properties.names:
            arrays = batched_arrays(world, properties, shape)
        self.model = PhysicsModel(world.model, arrays)
        self.map = state_map(compiled, world, self.model, own_start=own_start)
        self._substeps, self._scene = list(substeps), scene
        self._steps: Steps | None = None

    def source(self, *, added: AddedCode | None = None, knots: int = 1) -> str:
        """Source of a rollout, where parameters of the worlds are known; for registers its steps are compiled apart.

        Args:
            added: Statements that evaluate rollouts on the way.
            knots: Most knots that a control depends on.

        Raises:
            SceneError: If single precision does not hold one of its numbers.
            KernelError: If the steps do not compile.
        """
        shared = self.sharing > 1
        try:
            parts = RolloutSource(self.model, self.map, native_lanes(), shared, added, knots).parts()
        except OutOfRange as error:
            raise refusal(error, self._scene, self.world, self.layout) from error
        self.model.warn()
        if shared or wp.get_device(self.device).is_cuda:
            return parts.whole()
        self._steps = Steps(parts, f"the physics of {self._scene.name}")
        return packed(parts.rollouts())

    def fill(self, work: RolloutWork) -> None:
        """Set what the physics reads that no plan changes; after :meth:`source`."""
        columns, device = self.model.columns.values, self.device
        par = np.zeros((max(1, len(columns)), self.shape.worlds), dtype=np.float32)
        if self.redraw is None:
            for row, values in zip(par, columns, strict=False):
                row[:] = values
        if self._steps is not None:
            work.steps = self._steps.address
        work.substeps = wp.array(self._substeps, dtype=int, device=device)
        work.given = wp.array(self.model.given, dtype=float, device=device)
        work.par = wp.array(par, dtype=float, device=device)
        if self.redraw is not None:
            self.redraw.bind(self.model, work.par)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Record of :meth:`rollout`."""
        return Trajectory.allocate(self.shape, self.layout, len(self.pairs), self.device)

    @property
    def work(self) -> RolloutWork:
        """Work of rollouts of given controls; the controls of a step are its own knots."""
        return self._ready[1]

    @cached_property
    def _ready(self) -> tuple[wp.Kernel, RolloutWork]:
        """The kernel of rollouts of given controls, and what it takes."""
        source = self.source()
        kernel = make_kernel(source, native_lanes(), self.sharing)
        compile_kernel(kernel, self.device, WARP, f"the physics of {self._scene.name}", source=source)
        shape, work, out, device = self.shape, RolloutWork(), self.trajectory, self.device
        self.fill(work)
        tap = np.zeros((shape.envs, shape.horizon, int(TAPS)), dtype=np.int32)
        tap[:, :, 0] = np.arange(shape.horizon)
        share = np.zeros(tap.shape, dtype=np.float32)
        share[:, :, 0] = 1.0
        work.tap, work.share = wp.array(tap, device=device), wp.array(share, device=device)
        if self.map.own_start:
            m = self.world.model
            rows = shape.worlds, 1 + m.nq + m.nv + m.na
            work.initial, work.reached = (wp.zeros(rows, dtype=wp.float64, device=device) for _ in range(2))
        nu = self.layout.nu
        work.lower, work.upper = (wp.full(nu, sign * np.inf, dtype=float, device=device) for sign in (-1.0, 1.0))
        work.domains, work.records = 1, 1
        work.control, work.force = out.control, out.contact_force
        work.record_q, work.record_qd = out.joint_q, out.joint_qd
        work.record_body_q, work.record_body_qd, work.record_act = out.body_q, out.body_qd, out.act
        work.diverged, work.overflow = out.diverged, out.overflow
        return kernel, work

    def clone(self, state: ObservedState) -> None:
        """Let rollouts begin in an observed state."""
        work = self.work
        work.joint_q, work.joint_qd, work.act = state.joint_q, state.joint_qd, state.act
        work.mocap, work.pose = state.mocap, state.pose

    def rollout(self, control: wp.array) -> None:
        """Roll controls [T, W, nu] of all worlds out from the cloned state into :attr:`trajectory`, on this thread."""
        shape = self.shape
        knots = control.numpy().swapaxes(0, 1).reshape(shape.envs, shape.rollouts, shape.horizon, -1)
        self.work.knots = wp.array(np.ascontiguousarray(knots), dtype=float, device=self.device)
        self.launch(0, shape.envs * -(-shape.rollouts // self.lanes))

    def launch(self, first: int, groups: int) -> None:
        """Roll some groups of worlds out, with the knots of :attr:`work`, on this thread; capture-safe.

        Args:
            first: First group; one has as many worlds of an environment as there are :attr:`lanes`.
            groups: How many.
        """
        kernel, work = self._ready
        self._launch(kernel, groups * self.sharing, [first], [work], threads=WARP)
