# SPDX-License-Identifier: Apache-2.0
"""The engine ``newton``: all worlds in one Newton model, stepped together by one of its solvers.

The Newton model of all worlds of a batch.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import newton
import numpy as np
import warp as wp

from ..kernels.engine.clone import clone_state_kernel, finite_state_kernel, newton_control_kernel
from ..physics.runtime.launch import Launcher, default_device
from ..physics.version import BOUNDED_FORCES_DO_NOT_DAMP
from ..scene.errors import SceneError
from ..scene.model.builder import World, build_world
from ..scene.model.drawn_model import randomize_newton
from ..scene.model.importers import new_builder
from ..scene.model.joints import joint_table
from ..scene.model.mujoco_model import make_world
from ..scene.model.trajectory import BatchSize, Trajectory
from ..scene.schema import Solver
from .newton_solver import make_solver
from .protocol import LARGEST_SPEED, OnePart

if TYPE_CHECKING:
    from ..scene.model.compiled import CompiledScene
    from ..scene.model.layout import Layout
    from ..scene.model.pairs import Pair
    from ..scene.model.properties import Properties
    from ..scene.schema import Scene
    from ..scene.task.observed import ObservedState


def build_model(scene: Scene, worlds: int, device: str, *, over_tendons: bool = False) -> newton.Model:
    """Finalize a model of ``worlds`` copies of a scene.

    Args:
        scene: The scene.
        worlds: Number of worlds.
        device: Warp device.
        over_tendons: Whether servos drive over tendons of MuJoCo, see :func:`rows_over_tendons`.

    Raises:
        SceneError: If an asset is missing or broken, or the scene names links or joints that its asset lacks.
    """
    world, builder = build_world(scene), new_builder()
    if over_tendons:
        _drive_over_tendons(world)
    builder.replicate(world.builder, worlds)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Inertia validation corrected")  # the compiled scene says of which bodies
        return builder.finalize(device=device)


def rows_over_tendons(layout: Layout) -> dict[int, int]:
    """Rows of actuators that can drive over a tendon, and their joint: servos on joints of one axis.

    Such servos damp implicit steps at the joint's effort limit, in MuJoCo 4 those alone; see
    :func:`~warpmpc.scene.model.mujoco_model.keep_damping`. Their controls are ``control.mujoco.ctrl``, in this order.
    """
    joint_of = {int(dof): joint for joint, dof in enumerate(layout.joint_qd_start)}
    one_axis = (newton.JointType.PRISMATIC, newton.JointType.REVOLUTE)
    rows = {}
    for row, (dof, mode) in enumerate(zip(layout.actuator_dof, layout.actuator_mode, strict=True)):
        joint = joint_of.get(int(dof), -1)
        if mode in ("velocity", "position") and joint >= 0 and layout.joint_type[joint] in one_axis:
            rows[row] = joint
    return rows


def _drive_over_tendons(world: World) -> None:
    builder, layout, mujoco = world.builder, world.layout, newton.solvers.mujoco
    for row, joint in rows_over_tendons(layout).items():
        dof = int(layout.actuator_dof[row])
        stiffness, damping = float(builder.joint_target_ke[dof]), float(builder.joint_target_kd[dof])
        target = mujoco.ActuatorTarget.tendon(mujoco.add_tendon_fixed(builder, [(joint, 1.0)]))
        if layout.actuator_mode[row] == "velocity":
            mujoco.add_actuator_velocity(builder, target, kv=damping)
        else:
            mujoco.add_actuator_position(builder, target, kp=stiffness, kv=damping)
        builder.joint_target_mode[dof] = int(newton.JointTargetMode.NONE)


_MODES = {"velocity": 0, "position": 1, "effort": 2}


class NewtonSimulator(OnePart):
    """Rolls out W worlds of one replicated Newton model.

    Slice t of the trajectory is the memory of a ``newton.State``: the solver writes its result straight into the
    record. Everything after construction is a fixed sequence of launches without host synchronization or allocation,
    so that a whole plan can be captured in one CUDA graph. On the CPU the same launches run one by one, slowly.

    Args:
        scene: The scene; ``engine.solver`` and ``engine.options`` say which solver steps it.
        compiled: The scene, compiled.
        shape: Sizes of the batch.
        substeps: Physics steps in each control step ``[T]``.
        timestep: Length of a physics step [s].
        pairs: Pairs of entities whose contact force is watched.
        properties: Draws of physical properties; ``None`` leaves every world nominal.
        device: Warp device.

    Raises:
        SceneError: If the solver has no such option, or the scene brings what MuJoCo alone simulates.
    """

    name = "newton"

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
        device: str = "cuda",
    ):
        self.shape, self.substeps, self.pairs = shape, substeps, pairs
        self.device = str(wp.get_device(device))
        self._launch = Launcher(self.device)
        self.dt, layout = timestep, compiled.layout
        _refuse_mujocos_own(scene, compiled)
        if properties and properties.redrawn:
            raise SceneError(
                "the worlds of the engine newton keep what was drawn first: leave out redraw, or take mujoco_warp",
                key="randomize",
                file=scene.path,
            )
        with default_device(self.device):
            over_tendons = scene.engine.solver is Solver.MUJOCO and BOUNDED_FORCES_DO_NOT_DAMP
            self.model = build_model(scene, shape.worlds, self.device, over_tendons=over_tendons)
            self.model.set_gravity(layout.gravity)
            self.solver = make_solver(self.model, scene, compiled, shape, pairs)
            if properties and properties.names:
                world = make_world(compiled, timestep=timestep)
                changed = randomize_newton(self.model, layout, shape, properties, world)
                self.solver.solver.notify_model_changed(changed)
            self._table = joint_table(layout, self.device)
            self.trajectory = Trajectory.allocate(shape, layout, len(pairs), self.device)
            self._scratch = [self.model.state() for _ in range(min(max(substeps) - 1, 2))]
            self._make_controls(layout, list(rows_over_tendons(layout)) if over_tendons else [])

    @property
    def trajectory(self) -> Trajectory:
        """The record of all worlds; another one of its size may take its place."""
        return self._trajectory

    @trajectory.setter
    def trajectory(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory
        self._states = self._make_states()

    def _make_states(self) -> list[newton.State]:
        out, base = self.trajectory, self.model.state()
        states = []
        for t in range(self.shape.horizon + 1):
            state = copy.copy(base)
            state.joint_q, state.joint_qd = out.joint_q[t].flatten(), out.joint_qd[t].flatten()
            state.body_q, state.body_qd = out.body_q[t].flatten(), out.body_qd[t].flatten()
            states.append(state)
        return states

    def _make_controls(self, layout: Layout, direct: list[int]) -> None:
        """One control per step, in the memory of the target arrays.

        Args:
            layout: Layout of one world.
            direct: Rows of actuators that are MuJoCo's own, in its order.
        """
        t, w = self.shape.horizon, self.shape.worlds

        def upload(values: object, dtype: type) -> wp.array:
            return wp.array(values, dtype=dtype, device=self.device)

        self._target_q = wp.zeros((t, w, layout.nq), dtype=float, device=self.device)
        self._target_qd = wp.zeros((t, w, layout.nv), dtype=float, device=self.device)
        self._effort = wp.zeros((t, w, layout.nv), dtype=float, device=self.device)
        self._ctrl = wp.zeros((t, w, len(direct)), dtype=float, device=self.device)
        number = {row: i for i, row in enumerate(direct)}
        self._actuators = [
            upload(layout.actuator_matrix, float),
            upload(layout.actuator_offset, float),
            upload([_MODES[mode] for mode in layout.actuator_mode], int),
            upload(layout.actuator_dof, int),
            upload(layout.dof_coord[layout.actuator_dof], int),
            upload(np.minimum(layout.actuator_effort, 1e30), float),
            upload([number.get(row, -1) for row in range(len(layout.actuator_mode))], int),
        ]
        base = self.model.control()
        self._controls = []
        for i in range(t):
            control = copy.copy(base)
            control.joint_target_q = self._target_q[i].flatten()
            control.joint_target_qd = self._target_qd[i].flatten()
            control.joint_f = self._effort[i].flatten()
            if direct:
                control.mujoco = copy.copy(base.mujoco)
                control.mujoco.ctrl = self._ctrl[i].flatten()
            self._controls.append(control)

    def clone(self, state: ObservedState, first: int = 0, count: int | None = None) -> None:
        """Put every world into the observed state; warm starts and forces of earlier plans are gone with it."""
        count = self.shape.worlds - first if count is None else count
        out = self.trajectory
        self._launch(
            clone_state_kernel,
            count,
            [self._table, state.joint_q, state.joint_qd, self.shape.rollouts, first],
            [out.joint_q, out.joint_qd, out.body_q, out.body_qd],
        )

    def rollout(self, control: wp.array) -> None:
        """Roll controls [T, W, nu] of all worlds out from the cloned state into :attr:`trajectory`; capture-safe."""
        out = self.trajectory
        self._launch(
            newton_control_kernel,
            (*control.shape[:2], len(self._actuators[1])),
            [control, *self._actuators],
            [self._target_q, self._target_qd, self._effort, self._ctrl],
        )
        out.contact_force.zero_()
        out.overflow.zero_()
        self.solver.reset(self._states[0])
        for t in range(self.shape.horizon):
            self._control_step(t)
        self._launch(finite_state_kernel, self.shape.worlds, [out.joint_q, out.joint_qd, LARGEST_SPEED], [out.diverged])

    def _control_step(self, t: int, *, records: bool = True) -> None:
        """The physics steps of one control step, from slice t to slice t + 1; without a record the physics alone."""
        before, control, substeps = self._states[t], self._controls[t], self.substeps[t]
        for n in range(substeps):
            after = self._states[t + 1] if n == substeps - 1 else self._scratch[n % 2]
            self.solver.step(before, after, control, self.dt)
            if records:
                self.solver.add_forces(t, 1.0 / substeps, self.trajectory.contact_force, self.trajectory.overflow)
            before = after
        if records:
            self.solver.finish(before)

    def step_physics(self) -> None:
        """The physics alone: the same solver steps with the last controls, nothing recorded but their states."""
        for t in range(self.shape.horizon):
            self._control_step(t, records=False)

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed, and which setting to raise."""
        return self.solver.overflow_message(bits)

    def close(self) -> None:
        """Nothing to stop."""


_WITH_MUJOCOS_MODEL = ["mujoco", "mujoco_warp"]


def _refuse_mujocos_own(scene: Scene, compiled: CompiledScene) -> None:
    """Refuse what a Newton model lacks of MJCF files, drives, and obstacles that move."""
    if "acceleration" in compiled.layout.actuator_mode:
        raise SceneError(
            "drives of this mode are actuators of MuJoCo, which the engine newton does not simulate",
            key="engine.name",
            file=scene.path,
            allowed=_WITH_MUJOCOS_MODEL,
        )
    if compiled.layout.movable:
        raise SceneError(
            "the engine newton does not move obstacles: leave out movable, or take mujoco_warp",
            key=f"obstacle.{compiled.layout.movable[0]}.movable",
            file=scene.path,
            found=True,
        )
    for entity in compiled.layout.entities:
        if any(entity.damping):
            raise SceneError(
                "the engine newton does not damp objects: leave out their damping, or take mujoco_warp",
                key=f"object.{entity.name}",
                file=scene.path,
                found=list(entity.damping),
            )
    if not compiled.mjcf_robots:
        return
    layout, model = compiled.layout, compiled.spec().compile()
    found = {
        "actuators of the file (give the robot a drive)": any(compiled.actuator_name),
        "tendons": model.ntendon > 0,
        "equality constraints": model.neq > 0,
        "mocap bodies": layout.nm > 0,
        "flexes": model.nflex > 0,
        "gravity compensation": bool(model.body_gravcomp.any()),
        "springs": bool(model.jnt_stiffness.any()),
    }
    wrong = [name for name, there in found.items() if there]
    if wrong:
        raise SceneError(
            f"the engine newton does not simulate what an MJCF file brings: {', '.join(wrong)}",
            key="engine.name",
            file=scene.path,
            allowed=_WITH_MUJOCOS_MODEL,
        )
