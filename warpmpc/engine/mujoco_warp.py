# SPDX-License-Identifier: Apache-2.0
"""The engine ``mujoco_warp``: the scene's MuJoCo model in all worlds at once, by MuJoCo Warp.

What the engine ``mujoco`` compiles is put on the device as it is, in float32.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import mujoco_warp
import numpy as np
import warp as wp

from ..kernels.engine.clone import finite_state_kernel
from ..kernels.engine.contacts import mujoco_warp_contact_force_kernel
from ..kernels.engine.mujoco_warp import (
    drive_kernel,
    load_state_kernel,
    place_mocap_kernel,
    store_row_kernel,
    store_state_kernel,
)
from ..physics.collisions import colliding_pairs
from ..physics.runtime.launch import default_device
from ..scene.errors import SceneError
from ..scene.model.drawn_model import batched_arrays
from ..scene.model.mujoco_model import MujocoWorld, Options, make_world
from ..scene.model.pairs import pair_table
from ..scene.model.trajectory import BatchSize, Trajectory
from .protocol import LARGEST_SPEED, OnePart
from .redraw import RedrawnArrays
from .step_worlds import MujocoModelSimulator

if TYPE_CHECKING:
    from ..scene.model.compiled import CompiledScene
    from ..scene.model.layout import Layout
    from ..scene.model.pairs import Pair
    from ..scene.model.properties import Properties
    from ..scene.schema import Scene

CAPACITY_BITS = ~int(mujoco_warp.OverflowType.ITERATIONS | mujoco_warp.OverflowType.LS_ITERATIONS)
"""Overflow bits of MuJoCo Warp that tell of lost contacts or rows; a solver stopped early is no loss."""
_ROWS_PER_CONTACT = 4  # a pyramid with sliding friction
_LARGEST_BOUND = 256
"""Contact points per world beyond which the sum over all pairs of geoms says nothing about what happens at once."""
_POINTS = {frozenset(("box",)): 8, frozenset(("capsule",)): 2}
"""Most contact points between two geoms of these kinds; a sphere has one with anything, others up to four."""
_CAPACITIES = ("njmax", "njmax_nnz", "nconmax")
_GRAPH_CONDITIONAL = "graph_conditional"
"""MuJoCo Warp's own option: leave the solver's loop when all worlds have converged; else run every iteration."""
_ENUMS = {
    "solver": {"cg": mujoco.mjtSolver.mjSOL_CG, "newton": mujoco.mjtSolver.mjSOL_NEWTON},
    "integrator": {
        "euler": mujoco.mjtIntegrator.mjINT_EULER,
        "rk4": mujoco.mjtIntegrator.mjINT_RK4,
        "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    },
    "cone": {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC},
    "jacobian": {
        "dense": mujoco.mjtJacobian.mjJAC_DENSE,
        "sparse": mujoco.mjtJacobian.mjJAC_SPARSE,
        "auto": mujoco.mjtJacobian.mjJAC_AUTO,
    },
}
_NUMBERS = (
    *("iterations", "ls_iterations", "ccd_iterations", "sdf_iterations", "sdf_initpoints"),
    *("tolerance", "ls_tolerance", "ccd_tolerance", "impratio", "density", "viscosity", "wind", "magnetic"),
)
_FLAGS = {
    "enable_multiccd": (mujoco.mjtDisableBit.mjDSBL_MULTICCD, False),
    "disable_contacts": (mujoco.mjtDisableBit.mjDSBL_CONTACT, True),
}
"""Options that set (True) or clear (False) a bit of MuJoCo's ``disableflags``."""
OPTIONS = (*_CAPACITIES, _GRAPH_CONDITIONAL, *_ENUMS, *_NUMBERS, *_FLAGS)
"""Keys that a scene may have under ``engine.options``."""


class MujocoWarpSimulator(OnePart, MujocoModelSimulator):
    """Rolls out W worlds of one MuJoCo model with MuJoCo Warp.

    Everything after construction is a fixed sequence of launches without host synchronization or allocation, so that
    a whole plan can be captured in one CUDA graph. On the CPU the same launches run one by one, slowly.

    Args:
        scene: The scene; ``engine.options`` says what the solver does otherwise.
        compiled: The scene, compiled.
        shape: Sizes of the batch.
        substeps: Physics steps in each control step ``[T]``.
        timestep: Length of a physics step [s].
        pairs: Pairs of entities whose contact force is watched.
        properties: Draws of physical properties; ``None`` leaves every world nominal.
        sensors: Sensors to record, all if None; the others are left out of the model.
        device: Warp device.
    """

    name = "mujoco_warp"

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
        sensors: Collection[str] | None = None,
        device: str = "cuda",
    ):
        self.shape, self.substeps, self.pairs = shape, tuple(substeps), pairs
        self.device = str(wp.get_device(device))
        layout, options = compiled.layout, _checked(scene)
        world = make_world(compiled, timestep=timestep, options=Options.of(scene.engine), sensors=sensors)
        self.mj_model = world.model
        self.redraw: RedrawnArrays | None = None
        """Draws the properties of the worlds anew, None where they stay; capture-safe."""
        try:
            with default_device(self.device):
                _set_options(world.model, options)
                _refuse_rk4(world.model)
                self._put(world, layout, options, properties)
        except (TypeError, ValueError, KeyError, NotImplementedError) as error:  # what MuJoCo Warp refuses with
            raise SceneError(
                f"the solver refuses this scene or its options: {error}",
                key="engine.options",
                file=scene.path,
                found=dict(scene.engine.options),
            ) from error
        self.trajectory = Trajectory.allocate(shape, layout, len(pairs), self.device)
        self._bind(world, compiled)

    def _put(self, world: MujocoWorld, layout: Layout, options: dict, properties: Properties | None) -> None:
        shape, model = self.shape, world.model
        drawn = properties is not None and bool(properties.names)
        if drawn and properties.redrawn:
            self.redraw = RedrawnArrays(world, properties, shape, self.device)
        varied = batched_arrays(world, properties, shape) if drawn and self.redraw is None else {}
        names = self.redraw.names if self.redraw else varied
        self.model = mujoco_warp.put_model(model, batch_sizes=dict.fromkeys(names, shape.worlds))
        if self.redraw:
            self.redraw.bind(self.model)
        for name, values in varied.items():
            array = getattr(self.model, name)
            array.assign(values.astype(np.float32).reshape(array.numpy().shape))
        self.model.opt.graph_conditional = bool(options.get(_GRAPH_CONDITIONAL, True))
        self.model.opt.warn_overflow = 0  # overflows are gathered and told once, not printed by the GPU
        held = capacities(model, layout) | {name: options[name] for name in _CAPACITIES if name in options}
        self.data = mujoco_warp.make_data(model, nworld=shape.worlds, **held)

    def _bind(self, world: MujocoWorld, compiled: CompiledScene) -> None:
        """Tables and memory between Newton's conventions and MuJoCo's."""
        layout, model, shape, steps = compiled.layout, world.model, self.shape, self.shape.horizon
        self._bind_model(world, layout, np.arange(steps), self.device)
        width, rows = 1 + model.nq + model.nv + model.na, (shape.worlds, steps)

        def zeros(*dims: int) -> wp.array:
            return wp.zeros(dims, dtype=wp.float64, device=self.device)

        self._start, self._state, self._sensor = (
            zeros(shape.worlds, width),
            zeros(*rows, width),
            zeros(*rows, model.nsensordata),
        )
        shapes = np.full(model.ngeom, -1)
        for s, name in enumerate(compiled.geom_name):
            if name:
                shapes[model.geom(name).id] = s
        self._pairs = pair_table(layout, self.pairs, shapes.tolist(), self.device)

    def _write_mocap(self, poses: wp.array, order: wp.array, first: int, count: int) -> None:
        """Put mocap bodies of some worlds at poses ``[W, n]``."""
        placed = [self.data.mocap_pos, self.data.mocap_quat]
        self._launch(place_mocap_kernel, (count, order.size), [poses, order, first], placed)

    def rollout(self, control: wp.array) -> None:
        """Roll controls [T, W, nu] of all worlds out from the cloned state into :attr:`trajectory`; capture-safe."""
        self._control = control
        self.trajectory.contact_force.zero_()
        self.trajectory.overflow.zero_()
        self._load()
        self.step_physics(records=True)
        self._record()

    def step_physics(self, *, records: bool = False) -> None:
        """Step with the last controls; unless something is recorded, the physics alone."""
        with default_device(self.device):  # MuJoCo Warp's steps launch and allocate on the default device
            for t, substeps in enumerate(self.substeps):
                self._drive(t)
                for _ in range(substeps):
                    mujoco_warp.step(self.model, self.data)
                    if records:
                        self._add_forces(t, 1.0 / substeps)
                if records:
                    self._store(t)

    def _load(self) -> None:
        """Start the worlds from slice 0 of the trajectory; nothing of an earlier rollout remains."""
        data = self.data
        self._write_state(self._start, 0, self.shape.worlds)
        started = [data.time, data.qpos, data.qvel, data.act]
        self._launch(load_state_kernel, self._start.shape, [self._start], started)
        for array in (data.qacc_warmstart, data.qfrc_applied, data.xfrc_applied, data.ctrl):
            array.zero_()

    def _drive(self, t: int) -> None:
        dim = (self.shape.worlds, len(self._offset))
        self._launch(drive_kernel, dim, [self._control, self._matrix, self._offset, t], [self.data.ctrl])

    def _add_forces(self, t: int, share: float) -> None:
        """Add the contact forces of the last physics step to control step ``t`` and gather its overflows."""
        out, data, contact = self.trajectory, self.data, self.data.contact
        self._launch(
            mujoco_warp_contact_force_kernel,
            (max(data.naconmax, self.shape.worlds),),
            [
                *(self._pairs, int(self.mj_model.opt.cone), data.nacon),
                *(contact.worldid, contact.geom, contact.dim, contact.frame, contact.friction, contact.efc_address),
                *(data.efc.force, data.overflow, CAPACITY_BITS, t, share),
            ],
            [out.contact_force, out.overflow],
        )

    def _store(self, t: int) -> None:
        data, worlds = self.data, self.shape.worlds
        dim = (worlds, self._state.shape[2])
        self._launch(store_state_kernel, dim, [data.time, data.qpos, data.qvel, data.act, t], [self._state])
        if self._sensor.size:
            self._launch(store_row_kernel, (worlds, self._sensor.shape[2]), [data.sensordata, t], [self._sensor])

    def _record(self) -> None:
        """The record in Newton's conventions, with body poses, from what the worlds went through."""
        out, shape = self.trajectory, self.shape
        self._record_rows(self._state, self._sensor, 0, shape.worlds, shape.horizon)
        self._launch(
            finite_state_kernel, (self.shape.worlds,), [out.joint_q, out.joint_qd, LARGEST_SPEED], [out.diverged]
        )

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed, and which setting to raise."""
        return overflow_message(self.data, bits)

    def close(self) -> None:
        """Nothing to stop."""


def _checked(scene: Scene) -> dict[str, Any]:
    """The scene's options."""
    for name in scene.engine.options:
        if name not in OPTIONS:
            raise SceneError(
                "the engine mujoco_warp has no such option",
                key=f"engine.options.{name}",
                file=scene.path,
                found=name,
                allowed=OPTIONS,
            )
    return dict(scene.engine.options)


def _set_options(model: mujoco.MjModel, options: dict[str, Any]) -> None:
    """Set MuJoCo's own options of a model."""
    for name, value in options.items():
        if name in _ENUMS:
            if value not in _ENUMS[name]:
                raise ValueError(f"{name} = '{value}' is none of {', '.join(_ENUMS[name])}")
            setattr(model.opt, name, int(_ENUMS[name][value]))
        elif name in _NUMBERS:
            setattr(model.opt, name, value)
        elif name in _FLAGS:
            bit, sets = _FLAGS[name]
            on = bool(value) == sets
            model.opt.disableflags = (model.opt.disableflags | int(bit)) if on else (model.opt.disableflags & ~int(bit))


def _refuse_rk4(model: mujoco.MjModel) -> None:
    """MuJoCo Warp's RK4 takes activations otherwise than MuJoCo does: 1e-3 apart after 50 steps of a quadrotor."""
    if model.na and model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
        raise ValueError("RK4 with actuators that have activations: set engine.integrator to euler or implicitfast")


def overflow_message(data: mujoco_warp.Data, bits: int) -> str:
    """A sentence about what overflowed in the worlds of MuJoCo Warp, and which setting to raise."""
    return (
        f"the solver's capacity was exceeded (bits {bits:#x}): raise engine.options.nconmax (now "
        f"{data.naconmax // data.nworld} contacts per world) or engine.options.njmax (now {data.njmax} rows)"
    )


def capacities(model: mujoco.MjModel, layout: Layout) -> dict[str, int]:
    """Contacts and constraint rows that a world of MuJoCo Warp has room for, as its ``make_data`` takes them."""
    bound = max(min(contact_bound(model), _LARGEST_BOUND), 1)
    limits = int((abs(layout.dof_upper - layout.dof_lower) < 1e6).sum())
    limits += int(model.tendon_limited.sum()) + 6 * model.neq + int((model.dof_frictionloss > 0).sum())
    limits += int((model.tendon_frictionloss > 0).sum())
    return {"nconmax": bound, "njmax": max(_ROWS_PER_CONTACT * bound + limits, 1)}


def contact_bound(model: mujoco.MjModel) -> int:
    """Contact points one world can have at once: the sum over its pairs of geoms that may touch."""
    kinds = [mujoco.mjtGeom(int(kind)).name.removeprefix("mjGEOM_").lower() for kind in model.geom_type]
    total = 0
    for a, b in np.argwhere(np.triu(colliding_pairs(model), 1)):
        pair = frozenset((kinds[a], kinds[b]))
        total += 1 if "sphere" in pair else _POINTS.get(pair, 4)
    return total
