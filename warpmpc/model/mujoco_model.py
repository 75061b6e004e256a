# SPDX-License-Identifier: Apache-2.0
"""MuJoCo models of a compiled scene: time step, actuators, contact sensors, randomized properties."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from ..scene.errors import SceneError
from .compiled import CompiledScene
from .pairs import Pair
from .properties import Properties

_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
_NET_FORCE = 3  # reduce = "netforce"


@dataclass(frozen=True)
class MujocoWorld:
    """A MuJoCo model and how its arrays map to the layout."""

    model: mujoco.MjModel
    actuator_matrix: np.ndarray  # [na, nu] control → ctrl, in the model's actuator order
    actuator_offset: np.ndarray  # [na]
    joint_q: np.ndarray  # [nj] first qpos of each joint, -1 where it has none
    joint_qd: np.ndarray  # [nj] first qvel of each joint
    bodies: dict[str, tuple[int, ...]]  # entity → body ids
    geoms: dict[str, tuple[int, ...]]  # entity → geom ids


def make_world(
    compiled: CompiledScene,
    *,
    timestep: float,
    pairs: tuple[Pair, ...] = (),
    iterations: int = 20,
    tolerance: float = 1e-6,
) -> MujocoWorld:
    """Compile a MuJoCo model of a scene.

    Args:
        compiled: The scene.
        timestep: Physics step [s].
        pairs: Pairs of entities whose net contact force is measured by a sensor each, in this order.
        iterations: Largest number of constraint solver iterations.
        tolerance: Constraint solver tolerance.
    """
    layout = compiled.layout
    spec = mujoco.MjSpec.from_string(compiled.mjcf)
    spec.option.timestep = timestep
    spec.option.iterations = iterations
    spec.option.tolerance = tolerance
    # few bodies: looking for constraint islands costs more than it saves
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    _keep_servos(spec, compiled)
    for dof, mode, limit in zip(layout.actuator_dof, layout.actuator_mode, layout.actuator_effort, strict=True):
        if mode == "effort":
            actuator = spec.add_actuator(name=f"effort_{dof}", target=compiled.joint_name[dof])
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
            actuator.gainprm[0] = 1.0
            actuator.forcelimited = True
            actuator.forcerange = [-limit, limit]
    for i, pair in enumerate(pairs):
        _add_contact_sensor(spec, compiled, f"contact_{i}", pair)
    model = spec.compile()
    return MujocoWorld(model, *_actuators(model, compiled), *_joints(model, compiled), *_entities(model, compiled))


def _keep_servos(spec: mujoco.MjSpec, compiled: CompiledScene) -> None:
    """Delete actuators of the assets' own; the servos of the scene's drives come before them."""
    layout = compiled.layout
    modes = zip(layout.actuator_dof, layout.actuator_mode, strict=True)
    wanted = {compiled.joint_name[dof] for dof, mode in modes if mode != "effort"}
    for actuator in list(spec.actuators):
        if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and actuator.target in wanted:
            wanted.remove(actuator.target)
        else:
            spec.delete(actuator)


def _add_contact_sensor(spec: mujoco.MjSpec, compiled: CompiledScene, name: str, pair: Pair) -> None:
    sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
    sensor.objtype, sensor.objname = _contact_side(compiled, pair.first)
    sensor.reftype, sensor.refname = _contact_side(compiled, pair.second)
    sensor.intprm = [_FORCE, _NET_FORCE, 1]


def _contact_side(compiled: CompiledScene, name: str) -> tuple[mujoco.mjtObj, str]:
    entity = compiled.layout.entity(name)
    if entity.kind == "robot":
        return mujoco.mjtObj.mjOBJ_XBODY, compiled.body_name[entity.bodies[0]]  # the whole subtree
    if entity.bodies:
        return mujoco.mjtObj.mjOBJ_BODY, compiled.body_name[entity.bodies[0]]
    colliding = [compiled.geom_name[s] for s in entity.shapes if compiled.geom_name[s]]
    if not colliding:
        raise SceneError("this entity has no shape that collides", key="between", found=name)
    return mujoco.mjtObj.mjOBJ_GEOM, colliding[0]


def _actuators(model: mujoco.MjModel, compiled: CompiledScene) -> tuple[np.ndarray, np.ndarray]:
    layout = compiled.layout
    matrix = np.zeros((model.nu, layout.nu), dtype=np.float32)
    offset = np.zeros(model.nu, dtype=np.float32)
    for row, dof in enumerate(layout.actuator_dof):
        joint = model.joint(compiled.joint_name[dof]).id
        driving = [a for a in range(model.nu) if model.actuator_trnid[a, 0] == joint]
        for a in driving:
            matrix[a] = layout.actuator_matrix[row]
            offset[a] = layout.actuator_offset[row]
    return matrix, offset


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
        geoms[entity.name] = tuple(model.geom(name).id for name in names if name)
    return bodies, geoms


def randomize_model(world: MujocoWorld, properties: Properties, draw: int) -> mujoco.MjModel:
    """A copy of the model with the properties of one draw; inertia follows mass and size.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        draw: Which of them.
    """
    model = copy.copy(world.model)
    for i, name in enumerate(properties.names):
        factor = float(properties.mass[draw, i])
        for body in world.bodies[name]:
            model.body_mass[body] *= factor
            model.body_inertia[body] *= factor
        for geom in world.geoms[name]:
            model.geom_friction[geom, 0] *= float(properties.friction[draw, i])
            _resize(model, geom, properties.size[draw, i])
    if properties.names:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _resize(model: mujoco.MjModel, geom: int, offset: np.ndarray) -> None:
    """Add ``offset`` [3] to a primitive's dimensions [m] and scale its body's inertia accordingly."""
    if not offset.any():
        return
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))  # numpy integers do not hash like the enum
    if kind in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_MESH):
        return
    old = model.geom_size[geom].copy()
    new = old.copy()
    match kind:
        case mujoco.mjtGeom.mjGEOM_BOX:
            change = 0.5 * offset
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            change = offset[:1]
        case _:  # a radius and a half length
            change = offset[:2] * [1.0, 0.5]
    count = len(change)
    new[:count] = np.maximum(old[:count] + change, 0.1 * old[:count])
    model.geom_size[geom] = new
    body = model.geom_bodyid[geom]
    ratio = _unit_inertia(kind, new) / _unit_inertia(kind, old)
    if body:
        model.body_inertia[body] *= ratio[_axis_order(model, body)]
    match kind:
        case mujoco.mjtGeom.mjGEOM_BOX:
            box, radius = new, float(np.linalg.norm(new))
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            box, radius = np.full(3, new[0]), float(new[0])
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            box, radius = np.array([new[0], new[0], new[0] + new[1]]), float(new[0] + new[1])
        case _:
            box, radius = np.array([new[0], new[0], new[1]]), float(np.hypot(new[0], new[1]))
    model.geom_aabb[geom, 3:] = box
    model.geom_rbound[geom] = radius


def _unit_inertia(kind: mujoco.mjtGeom, size: np.ndarray) -> np.ndarray:
    """Principal inertia per mass [m²] of a primitive with MuJoCo's half sizes."""
    x, y, z = size
    match kind:
        case mujoco.mjtGeom.mjGEOM_BOX:
            return np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 3.0
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return np.full(3, 0.4 * x * x)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            length = 2.0 * y
            caps = 4.0 * x / (4.0 * x + 3.0 * length)  # share of the mass
            across = (1.0 - caps) * (3.0 * x * x + length * length) / 12.0
            across += caps * (0.4 * x * x + length * (3.0 * x + 2.0 * length) / 8.0)
            along = (0.5 * (1.0 - caps) + 0.4 * caps) * x * x
            return np.array([across, across, along])
        case _:
            return np.array([x * x / 4.0 + y * y / 3.0, x * x / 4.0 + y * y / 3.0, x * x / 2.0])


def _axis_order(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Geometry axis that each principal axis of a body's inertia lies along."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
    return np.argmax(np.abs(rotation.reshape(3, 3)), axis=0)
