# SPDX-License-Identifier: Apache-2.0
"""MuJoCo models of a compiled scene: options, actuators, sensors, and how their arrays map to the layout."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...physics.collisions import colliding_pairs
from ...physics.version import BOUNDED_FORCES_DO_NOT_DAMP, SPARSE_IS_WRONG
from ..errors import SceneError
from .layout import accelerator
from .mjcf_mocap import movable_body
from .pairs import Pair

if TYPE_CHECKING:
    from collections.abc import Collection

    from ..schema import EngineSettings
    from .compiled_scene import CompiledScene
    from .layout import Layout

_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
_NET_FORCE = 3  # reduce = "netforce"


@dataclass(frozen=True)
class MujocoWorld:
    """A MuJoCo model and how its arrays map to the layout."""

    model: mujoco.MjModel
    actuator_matrix: np.ndarray  # [model.nu, nu] control → ctrl, in the model's actuator order
    actuator_offset: np.ndarray  # [model.nu]
    joint_q: np.ndarray  # [nj] first qpos of each joint, -1 where it has none
    joint_qd: np.ndarray  # [nj] first qvel of each joint
    activation: np.ndarray  # [na] activation of the model behind each of the layout's
    mocap: np.ndarray  # [nm] mocap body of the model behind each of the layout's
    movable: np.ndarray  # [n] mocap body of the model behind each obstacle that moves with the task
    sensor: np.ndarray  # [ns] number of the model's sensors behind each of the layout's, -1 where it is left out
    pair_sensor: np.ndarray  # [pairs + 1] first contact sensor of each pair, counted from the first of all
    bodies: dict[str, tuple[int, ...]]  # entity → body ids
    geoms: dict[str, tuple[int, ...]]  # entity → geom ids
    averaged: np.ndarray  # [n] pairs of the model whose friction is the average of their geoms'
    damped: tuple[int, ...] = ()  # bodies of objects whose velocities decay

    @property
    def sensors(self) -> int:
        """Number of sensors before those of contacts."""
        return self.model.nsensor - int(self.pair_sensor[-1])

    @property
    def first_contact(self) -> int:
        """Index of the first contact sensor among the numbers of all sensors; they come last."""
        return self.model.nsensordata - 3 * int(self.pair_sensor[-1])


_INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
_CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}


@dataclass(frozen=True)
class Options:
    """Physics options that a scene gives; what is None is as the MJCF file says, or as said here without one."""

    iterations: int | None = None
    """Largest number of constraint solver iterations, else 20."""
    tolerance: float | None = None
    """Constraint solver tolerance, else 1e-6."""
    integrator: str | None = None
    """``euler``, ``rk4``, ``implicit`` or ``implicitfast``, the default."""
    cone: str | None = None
    """``pyramidal``, the default, or ``elliptic``."""
    impratio: float | None = None
    """Ratio of friction to normal constraint impedance, else 1."""
    friction_combine: str | None = None
    """``average``, or ``priority``, the default."""

    @classmethod
    def of(cls, engine: EngineSettings, **changes: object) -> Options:
        """The options of a scene's ``engine`` table, with some changed."""
        return replace(cls(*(getattr(engine, item.name) for item in fields(cls))), **changes)


def make_world(
    compiled: CompiledScene,
    *,
    timestep: float,
    pairs: tuple[Pair, ...] = (),
    options: Options | None = None,
    sensors: Collection[str] | None = None,
) -> MujocoWorld:
    """Compile a MuJoCo model of a scene.

    Args:
        compiled: The scene.
        timestep: Physics step [s].
        pairs: Pairs of entities whose net contact force is measured, in this order.
        options: What the scene says about the physics.
        sensors: Sensors of MJCF files to keep; every other one costs time and is left out. ``None`` keeps all.
    """
    layout = compiled.layout
    spec = compiled.spec()
    _set_options(spec, compiled, options or Options(), timestep)
    known = set(layout.sensor_name) if sensors is None else set(sensors)
    for sensor in list(spec.sensors):
        if sensor.name not in known:
            spec.delete(sensor)
    _keep_servos(spec, compiled)
    for row in range(len(layout.actuator_dof)):
        _add_actuator(spec, compiled, row)
    keep_damping(spec, compiled.actuator_name)
    counts = [_add_contact_sensors(spec, compiled, f"contact_{i}", pair) for i, pair in enumerate(pairs)]
    model = spec.compile()
    if options is not None and options.friction_combine == "average":
        model = _with_average_friction(spec, model, compiled)
    damped = _damp(model, compiled)
    return MujocoWorld(
        model,
        *_actuators(model, compiled),
        *_joints(model, compiled),
        *_states(model, layout),
        _sensors(model, layout),
        np.cumsum([0, *counts], dtype=np.int32),
        *_entities(model, compiled),
        np.flatnonzero([model.pair(p).name.startswith(_AVERAGED) for p in range(model.npair)]),
        damped,
    )


def _damp(model: mujoco.MjModel, compiled: CompiledScene) -> tuple[int, ...]:
    """Let velocities of objects decay at the rates of the scene; returns the bodies of those that have any."""
    out = []
    for entity in compiled.layout.entities:
        if any(entity.damping):
            body = model.body(compiled.body_name[entity.bodies[0]]).id
            first = int(model.body_dofadr[body])
            inertia = np.empty(3)
            inertia[axis_order(model, body)] = model.body_inertia[body]
            model.dof_damping[first : first + 3] = entity.damping[0] * model.body_mass[body]
            model.dof_damping[first + 3 : first + 6] = entity.damping[1] * inertia
            out.append(body)
    return tuple(out)


def axis_order(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Geometry axis that each principal axis of a body's inertia lies along."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
    return np.argmax(np.abs(rotation.reshape(3, 3)), axis=0)


_AVERAGED = "average_friction_"
"""Begin of the names of pairs whose friction is the average of their geoms'."""
_PAIR_FRICTION = [0, 0, 1, 2, 2]
"""A geom's coefficients of friction in the order of a pair's."""


def _with_average_friction(spec: mujoco.MjSpec, model: mujoco.MjModel, compiled: CompiledScene) -> mujoco.MjModel:
    """A model in which two geoms of different entities slide with the average of both frictions.

    MuJoCo has no such rule: every two that may touch become an explicit pair, whose other parameters are those that
    MuJoCo mixes from the geoms; a file's own pairs stay as they are.
    """
    owner = np.full(model.ngeom, -1)
    for i, geoms in enumerate(_entities(model, compiled)[1].values()):
        owner[list(geoms)] = i
    told = {frozenset(pair) for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
    for n, geom in enumerate(spec.geoms):
        geom.name = geom.name or f"{_AVERAGED}{n}"
    named = spec.compile()
    for a, b in np.argwhere(np.triu(colliding_pairs(model), 1)).tolist():
        if owner[a] != owner[b] and {a, b} not in told:
            name = f"{_AVERAGED}{a}_{b}"
            spec.add_pair(name=name, geomname1=named.geom(a).name, geomname2=named.geom(b).name)
    model = spec.compile()
    for p in range(model.npair):
        if model.pair(p).name.startswith(_AVERAGED):
            model.pair_friction[p] = average_friction(model.geom_friction, model.pair_geom1[p], model.pair_geom2[p])
    return model


def average_friction(friction: np.ndarray, first: int, second: int) -> np.ndarray:
    """Friction of a pair ``[..., 5]``, the average of its geoms' ``[..., ngeom, 3]``."""
    return 0.5 * (friction[..., first, :] + friction[..., second, :])[..., _PAIR_FRICTION]


def _set_options(spec: mujoco.MjSpec, compiled: CompiledScene, options: Options, timestep: float) -> None:
    option = spec.option
    option.timestep = timestep
    if options.iterations is not None or not compiled.mjcf_robots:
        option.iterations = 20 if options.iterations is None else options.iterations
    if options.tolerance is not None or not compiled.mjcf_robots:
        option.tolerance = 1e-6 if options.tolerance is None else options.tolerance
    if options.integrator is not None:
        option.integrator = _INTEGRATORS[options.integrator]
    if options.cone is not None:
        option.cone = _CONES[options.cone]
    if options.impratio is not None:
        option.impratio = options.impratio
    if SPARSE_IS_WRONG:
        option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # few bodies: looking for constraint islands costs more than it saves, and changes nothing but the time
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)


_OF_SCENE = ("effort", "acceleration")
"""Drives whose actuators Newton does not make."""


def _add_actuator(spec: mujoco.MjSpec, compiled: CompiledScene, row: int) -> None:
    """Add the actuator of a drive that Newton makes none for.

    An acceleration is integrated by the actuator itself into the set point of a velocity servo (as MuJoCo's
    ``intvelocity`` does for positions), which stays within the joint's speed limit.
    """
    layout = compiled.layout
    dof, mode, limit = layout.actuator_dof[row], layout.actuator_mode[row], float(layout.actuator_effort[row])
    if mode not in _OF_SCENE:
        return
    name = f"effort_{dof}" if mode == "effort" else accelerator(dof)
    actuator = spec.add_actuator(name=name, target=compiled.joint_name[dof])
    actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
    actuator.gainprm[0] = 1.0
    actuator.forcelimited = True
    actuator.forcerange = [-limit, limit]
    if mode == "acceleration":
        gain, speed = float(layout.actuator_damping[row]), float(layout.actuator_speed[row])
        actuator.dyntype = mujoco.mjtDyn.mjDYN_INTEGRATOR
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0], actuator.biasprm[2] = gain, -gain
        actuator.actlimited = True
        actuator.actrange = [-speed, speed]


def _keep_servos(spec: mujoco.MjSpec, compiled: CompiledScene) -> None:
    """Delete actuators that belong neither to the scene's drives nor to MJCF files that are driven by their own."""
    layout, own = compiled.layout, set(compiled.actuator_name)
    modes = zip(layout.actuator_dof, layout.actuator_mode, strict=True)
    wanted = {compiled.joint_name[dof] for dof, mode in modes if mode not in _OF_SCENE}
    for actuator in list(spec.actuators):
        if actuator.name and actuator.name in own:
            continue
        if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and actuator.target in wanted:
            wanted.remove(actuator.target)
        else:
            spec.delete(actuator)


def keep_damping(spec: mujoco.MjSpec, own: Collection[str] = ()) -> None:
    """Let servos drive joints over tendons: from MuJoCo 4 on those alone damp implicit steps at ``actuatorfrcrange``.

    Long steps, as rollouts have, go to and fro at the limit of a force that they do not damp.

    Args:
        spec: The model.
        own: Names of actuators that stay as they are.
    """
    if not BOUNDED_FORCES_DO_NOT_DAMP:
        return
    for n, servo in enumerate(spec.actuators):
        on_joint = servo.trntype == mujoco.mjtTrn.mjTRN_JOINT and not (servo.name and servo.name in own)
        if on_joint and not np.any(servo.forcerange) and servo.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
            tendon = spec.add_tendon(name=f"servo_{n}")
            tendon.wrap_joint(servo.target, 1.0)
            servo.trntype, servo.target = mujoco.mjtTrn.mjTRN_TENDON, tendon.name


def _add_contact_sensors(spec: mujoco.MjSpec, compiled: CompiledScene, name: str, pair: Pair) -> int:
    """One sensor for every two parts of a pair's entities, whose forces add up; returns how many."""
    sides = [(a, b) for a in _contact_sides(compiled, pair.first) for b in _contact_sides(compiled, pair.second)]
    for i, (first, second) in enumerate(sides):
        sensor = spec.add_sensor(name=f"{name}_{i}", type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = first
        sensor.reftype, sensor.refname = second
        sensor.intprm = [_FORCE, _NET_FORCE, 1]
    return len(sides)


def _contact_sides(compiled: CompiledScene, name: str) -> list[tuple[mujoco.mjtObj, str]]:
    """The parts of an entity: the trees of its bodies, and its colliding geoms that are fixed to the world."""
    layout = compiled.layout
    entity = layout.entity(name)
    sides = []
    if entity.kind == "robot":
        above = dict(zip(layout.joint_child.tolist(), layout.joint_parent.tolist(), strict=True))
        roots = [b for b in entity.bodies if above[b] not in entity.bodies]
        sides += [(mujoco.mjtObj.mjOBJ_XBODY, compiled.body_name[b]) for b in roots]  # with all that hangs on it
    elif entity.bodies:
        return [(mujoco.mjtObj.mjOBJ_BODY, compiled.body_name[entity.bodies[0]])]
    fixed = [s for s in entity.shapes if layout.shapes[s].body < 0 and layout.shapes[s].collides]
    sides += [(mujoco.mjtObj.mjOBJ_GEOM, compiled.geom_name[s]) for s in fixed if compiled.geom_name[s]]
    if not sides:
        raise SceneError("this entity has no shape that collides", key="between", found=name)
    return sides


def _actuators(model: mujoco.MjModel, compiled: CompiledScene) -> tuple[np.ndarray, np.ndarray]:
    layout = compiled.layout
    matrix = np.zeros((model.nu, layout.nu), dtype=np.float32)
    offset = np.zeros(model.nu, dtype=np.float32)
    own = {name: i for i, name in enumerate(compiled.actuator_name) if name}
    driven = {model.joint(compiled.joint_name[dof]).id: row for row, dof in enumerate(layout.actuator_dof)}
    for a in range(model.nu):
        name = model.actuator(a).name
        if name in own:
            matrix[a, own[name]] = 1.0
        else:  # a servo of a drive
            row = driven[driven_joint(model, a)]
            matrix[a], offset[a] = layout.actuator_matrix[row], layout.actuator_offset[row]
    return matrix, offset


def driven_joint(model: mujoco.MjModel, actuator: int) -> int:
    """Joint that an actuator drives, directly or over a tendon that is one joint's coordinate; -1 for all others."""
    kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
        return target
    if kind != mujoco.mjtTrn.mjTRN_TENDON or model.tendon_num[target] != 1:
        return -1
    first = int(model.tendon_adr[target])
    return int(model.wrap_objid[first]) if model.wrap_prm[first] == 1.0 else -1


def _states(model: mujoco.MjModel, layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Activation, mocap body and movable obstacle of the model behind each of the layout's."""
    first: dict[str, int] = {}
    activation = []
    for name in layout.activation_name:
        activation.append(model.actuator(name).actadr[0] + first.get(name, 0))
        first[name] = first.get(name, 0) + 1
    mocap = [model.body(name).mocapid[0] for name in layout.mocap_name]
    movable = [model.body(movable_body(name)).mocapid[0] for name in layout.movable]
    return tuple(np.array(found, dtype=np.int32) for found in (activation, mocap, movable))


def _sensors(model: mujoco.MjModel, layout: Layout) -> np.ndarray:
    columns = np.full(layout.ns, -1, dtype=np.int32)
    there = {model.sensor(s).name: int(model.sensor_adr[s]) for s in range(model.nsensor)}
    for name, start, dim in zip(layout.sensor_name, layout.sensor_start, layout.sensor_dim, strict=True):
        if name in there:
            columns[start : start + dim] = there[name] + np.arange(dim)
    return columns


def _joints(model: mujoco.MjModel, compiled: CompiledScene) -> tuple[np.ndarray, np.ndarray]:
    layout = compiled.layout
    q = np.full(len(layout.joint_type), -1, dtype=np.int32)
    qd = q.copy()
    for j, start in enumerate(layout.joint_qd_start):
        if start < layout.nv and layout.joint_dof_dim[j].sum() and compiled.joint_name[start]:
            joint = model.joint(compiled.joint_name[start])
            q[j], qd[j] = joint.qposadr[0], joint.dofadr[0]
    return q, qd


def _entities(model: mujoco.MjModel, compiled: CompiledScene) -> tuple[dict, dict]:
    bodies, geoms = {}, {}
    for entity in compiled.layout.entities:
        bodies[entity.name] = tuple(model.body(compiled.body_name[b]).id for b in entity.bodies)
        names = [compiled.geom_name[s] for s in entity.shapes]
        # heightfields are no shapes, but of the file whose floors are
        fields = [model.geom(g).name for g in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)]
        names += [name for name in fields if entity.kind == "robot" and name.startswith(f"{entity.name}/")]
        geoms[entity.name] = tuple(model.geom(name).id for name in names if name)
    return bodies, geoms
