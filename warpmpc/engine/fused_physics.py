# SPDX-License-Identifier: Apache-2.0
"""The physics of a scene in the engine ``fused``: its model, its source, and rollouts of given controls.

Places of a scene's numbers in the physics.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from ..kernels.engine.launch import TAPS
from ..kernels.geometry.kinematics import BALL, FREE
from ..physics.batch import shares
from ..physics.model import PhysicsModel
from ..physics.runtime.bake import OutOfRange, native_lanes
from ..physics.runtime.compiling import compile_kernel
from ..physics.runtime.launch import Launcher
from ..physics.sensors import Readings, sensed_bodies, unread_sensors, write_readings
from ..physics.source import RolloutSource
from ..physics.source_parts import WARP, RolloutWork, Steps, make_kernel, packed
from ..physics.state_map import StateMap, Turn, Watch
from ..physics.unsupported import missing, tell_differences
from ..scene.errors import SceneError
from ..scene.model.drawn_model import batched_arrays
from ..scene.model.mujoco_model import Options, driven_joint, make_world
from ..scene.model.pairs import Pair
from ..scene.model.trajectory import Trajectory
from .redraw import RedrawnColumns

if TYPE_CHECKING:
    from ..physics.source_parts import AddedCode
    from ..scene.model.compiled import CompiledScene
    from ..scene.model.layout import Layout
    from ..scene.model.mujoco_model import MujocoWorld
    from ..scene.model.properties import Properties
    from ..scene.model.trajectory import BatchSize
    from ..scene.schema import Scene
    from ..scene.task.observed import ObservedState


def state_map(compiled: CompiledScene, world: MujocoWorld, model: PhysicsModel, *, own_start: bool = False) -> StateMap:
    """The map from a scene's numbers to those of its MuJoCo model.

    Args:
        compiled: The scene, compiled.
        world: Its MuJoCo model, with sensors of the contact forces that are watched.
        model: The same as the physics reads it.
        own_start: Whether every world starts in a different state.
    """
    layout = compiled.layout
    bodies = [world.model.body(name).id for name in compiled.body_name]
    sensors = world.sensors
    sensed = sensed_bodies(model, sensors)
    kept = sorted({*bodies, *sensed})
    places = np.argsort(np.where(world.sensor < 0, layout.ns, world.sensor))[: int((world.sensor >= 0).sum())]
    return StateMap(
        matrix=world.actuator_matrix,
        offset=world.actuator_offset,
        own_start=own_start,
        coordinates=_straight(layout, layout.joint_q_start, world),
        speeds=_straight(layout, layout.joint_qd_start, world, speeds=True),
        turns=[_turn(layout, j, world) for j in _joints(layout, world, turning=True)],
        bodies=bodies,
        centres=layout.body_com,
        mocap=world.mocap,
        movable=world.movable,
        activations=world.activation.tolist(),
        watched=watched(model, world),
        pairs=len(world.pair_sensor) - 1,
        sensors=sensors,
        sensed=sensed,
        readings=write_readings(model, sensors, kept, places.tolist()) if sensors else Readings(),
    )


def _joints(layout: Layout, world: MujocoWorld, *, turning: bool) -> list[int]:
    """Joints of the layout that the model has: free and ball joints, or all others."""
    kinds = layout.joint_type
    return [
        j for j in range(len(kinds)) if world.joint_q[j] >= 0 and (int(kinds[j]) in (int(FREE), int(BALL))) == turning
    ]


def _straight(layout: Layout, first: np.ndarray, world: MujocoWorld, *, speeds: bool = False) -> dict[int, int]:
    """The model's number behind each of the layout's, of slides and hinges."""
    start, out = world.joint_qd if speeds else world.joint_q, {}
    for j in _joints(layout, world, turning=False):
        out |= {int(first[j]) + i: int(start[j]) + i for i in range(int(layout.joint_dof_dim[j].sum()))}
    return out


def _turn(layout: Layout, j: int, world: MujocoWorld) -> Turn:
    return Turn(
        joint=j,
        ball=int(layout.joint_type[j]) == int(BALL),
        q=int(layout.joint_q_start[j]),
        v=int(layout.joint_qd_start[j]),
        model_q=int(world.joint_q[j]),
        model_v=int(world.joint_qd[j]),
        body=int(layout.joint_child[j]),
        parent=layout.joint_pose_parent[j],
        child=layout.joint_pose_child[j],
    )


def watched(model: PhysicsModel, world: MujocoWorld) -> list[Watch]:
    """Pairs of geoms whose forces count towards the watched pairs of entities, by the model's contact sensors."""
    m, out = world.model, []
    first = world.sensors
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


LARGE = 1e15
"""Numbers from here on are named: their squares overflow with a few factors more."""
_NUMBERS = {
    "body_mass": "mass",
    "body_inertia": "moment of inertia",
    "geom_size": "size",
    "dof_armature": "armature",
    "dof_damping": "damping",
    "dof_frictionloss": "dry friction",
    "jnt_stiffness": "stiffness",
    "actuator_gainprm": "gain",
    "actuator_biasprm": "gain",
    "actuator_gear": "gear",
}
"""Arrays of a MuJoCo model, and what one of their numbers is called; causes stand before what follows from them."""


class FusedPhysics:
    """The worlds of a scene.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        shape: Environments, samples, domains and horizon.
        substeps: Physics steps in each control step ``[T]``.
        timestep: Length of a physics step [s].
        pairs: Pairs of entities whose contact force is watched.
        sensors: Sensors that are read and recorded, by name.
        properties: Draws of physical properties; ``None`` leaves every world nominal.
        device: Warp device.
        own_start: Whether every world starts in its own state, in ``initial`` of :attr:`work`.

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
        sensors: Collection[str] = (),
        properties: Properties | None = None,
        device: str = "cpu",
        own_start: bool = False,
    ):
        self.shape, self.pairs, self.device = shape, pairs, device
        world = make_world(compiled, timestep=timestep, pairs=pairs, options=Options.of(scene.engine), sensors=sensors)
        if lack := missing(world.model) or _unread(world):
            allowed = ["auto", "mujoco", "mujoco_warp"]
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
            raise _refusal(error, self._scene, self.world, self.layout) from error
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
        work.diverged, work.overflow, work.sensor = out.diverged, out.overflow, out.sensor
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


def _unread(world: MujocoWorld) -> str | None:
    """Return the sensors of a scene that cannot be read, in a few words; None if there are none."""
    unread = unread_sensors(world.model, world.sensors)
    if int(mujoco.mjtSensor.mjSENS_CLOCK) in world.model.sensor_type[: world.sensors]:
        unread.append("clock")
    return f"sensors of the kinds {', '.join(unread)}, which cost terms read" if unread else None


def _refusal(error: OutOfRange, scene: Scene, world: MujocoWorld, layout: Layout) -> SceneError:
    """The error for a model with a number that is too large, which it names where it is found."""
    message = f"the engine fused: {error}"
    for array, what in _NUMBERS.items():
        rows = getattr(world.model, array)
        largest = np.abs(rows).reshape(len(rows), -1).max(axis=1, initial=0.0)
        owner = _owner(world, array, int(largest.argmax())) if (largest > LARGE).any() else None
        if owner is not None:
            message += f", and '{owner}' has {largest.max():g} as its {what}: lower it, or take the engine mujoco"
            return SceneError(message, key=f"{layout.entity(owner).kind}.{owner}", file=scene.path)
    return SceneError(message, key="engine.name", file=scene.path, allowed=["auto", "mujoco", "mujoco_warp"])


def _owner(world: MujocoWorld, array: str, row: int) -> str | None:
    """Robot, object or obstacle that a row of an array of the model belongs to; None where there is none."""
    m = world.model
    if array.startswith("body"):
        body = row
    elif array.startswith("actuator"):
        joint = driven_joint(m, row)
        body = int(m.jnt_bodyid[joint]) if joint >= 0 else -1
    else:
        body = int(getattr(m, f"{array.partition('_')[0]}_bodyid")[row])
    return next((name for name, bodies in world.bodies.items() if body in bodies), None)
