# SPDX-License-Identifier: Apache-2.0
"""A user's MJCF file: read as its author wrote it, every element named, changed only where the scene says so."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import mujoco
import numpy as np

from ..errors import SceneError
from ..schema_bodies import Robot
from .mjcf_elements import Key, keep_total_mass, motor_limits, refusal, repair_spec, replaced_words, take_keys
from .mjcf_mocap import drive_mocap

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

FREE = mujoco.mjtJoint.mjJNT_FREE
SPECK = {"pos": "0 0 0", "mass": "1e-6", "diaginertia": "2e-15 2e-15 2e-15"}
"""A mass [kg] and inertia [kg m²] that no joint notices, small enough in size for a medium not to, either."""


@dataclass(frozen=True)
class Servo:
    """The servo that a drive puts on one joint of an MJCF robot."""

    joint: str
    mode: str
    """``velocity``, ``position`` or ``effort``."""
    stiffness: float
    damping: float
    effort: float
    """Largest force or torque [N or N·m]."""
    armature: float | None = None
    """Rotor inertia [kg or kg·m²]; the asset's own when None."""


@dataclass(frozen=True)
class MjcfRobot:
    """A robot whose MJCF file goes into the MuJoCo model as it is."""

    path: str
    robot: Robot
    servos: tuple[Servo, ...] = ()
    """Servos of the robot's drives; without any, the asset's own actuators stay."""
    place: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    """Where the origin of the file is (x, y, z, qx, qy, qz, qw)."""


@dataclass(frozen=True)
class Mjcf:
    """Content of an MJCF file."""

    spec: mujoco.MjSpec
    keys: tuple[Key, ...]
    motors: dict[str, float]
    """Joint → largest force of its actuators that the scene's drives replace [N or N·m]."""
    replaced: tuple[str, ...]
    """Lines on these actuators."""
    left_out: tuple[str, ...]
    """What was not taken over, and why."""
    repaired: tuple[str, ...]
    """What is not as the file says, one line each."""
    mocap: dict[int, tuple[str, ...]]
    """Number of a drive → joints that its mocap body is put on."""


def read_mjcf(mjcf_robot: MjcfRobot, *, file: Path | None = None) -> Mjcf:
    """Read an MJCF file and change what the scene changes: root, servos, friction, self-collision, gravity.

    Args:
        mjcf_robot: The robot.
        file: Scene file, for errors.

    Raises:
        SceneError: If MuJoCo cannot read or compile the file, or it has a root that can be neither welded nor freed.
    """
    robot, key = mjcf_robot.robot, f"robot.{mjcf_robot.robot.name}"
    try:
        spec = mujoco.MjSpec.from_file(mjcf_robot.path)
        spec.compiler.fusestatic = spec.compiler.discardvisual = False  # every body and geom keeps its name
        left_out = _drop_broken_sensors(spec)
        _name_everything(spec)
        repaired = repair_spec(spec)
        keep_total_mass(spec)
        spec, divided = _split_hinges(spec)
        keys = take_keys(spec)
        _set_root(spec, robot, key, file)
        mocap, keys = drive_mocap(spec, robot, keys, file)
    except ValueError as error:
        raise SceneError(
            f"this asset cannot be read: {refusal(error)}", key=f"{key}.asset", file=file, found=mjcf_robot.path
        ) from error
    if robot.friction is not None:
        for geom in spec.geoms:
            geom.friction[0] = robot.friction
    if robot.gravity_compensation:
        for body in spec.bodies[1:]:
            body.gravcomp = 1.0
    if robot.self_collision is False:
        for pair in list(spec.pairs):
            spec.delete(pair)
    motors = {} if robot.keeps_actuators else motor_limits(spec)
    replaced = () if robot.keeps_actuators else tuple(replaced_words(spec, motors))
    if not robot.keeps_actuators:
        for actuator in list(spec.actuators):
            spec.delete(actuator)
    for servo in mjcf_robot.servos:
        _add_servo(spec, servo)
    return Mjcf(spec, keys, motors, replaced, tuple(left_out), (*repaired, *divided), mocap)


def origin_of(robot: Robot, model: mujoco.MjModel, key: Key | None, mocap: Collection[str]) -> tuple[float, ...]:
    """Place of a file's origin at which its root, the first body that moves, is where the scene puts it.

    Args:
        robot: The robot.
        model: The file's own model.
        key: Keyframe that the robot starts in, if any.
        mocap: Joints of driven mocap bodies, which are no roots.

    Returns:
        The pose (x, y, z, qx, qy, qz, qw).
    """
    led = {int(model.joint(name).bodyid[0]) for name in mocap}
    moving = [int(model.body_rootid[b]) for b in range(1, model.nbody) if model.body_dofnum[b] and b not in led]
    root = min(moving, default=min(1, model.nbody - 1))  # an empty file is refused later
    own = np.concatenate([model.body_pos[root], model.body_quat[root]])
    joint = int(model.body_jntadr[root])
    if key is not None and joint >= 0 and model.jnt_type[joint] == FREE:
        own = np.array(key.qpos[model.joint(joint).name])
    x, y, z, w = robot.rotation or (*own[4:], own[3])
    back, place = (np.zeros(3), np.zeros(4)), (np.zeros(3), np.zeros(4))
    mujoco.mju_negPose(*back, own[:3], own[3:])
    mujoco.mju_mulPose(*place, np.array(robot.position or own[:3]), np.array([w, x, y, z]), *back)
    return (*place[0].tolist(), *place[1][1:].tolist(), float(place[1][0]))


def gravity_of(option: mujoco.MjOption) -> tuple[float, ...]:
    """Gravity's acceleration under some options (x, y, z) [m/s²]."""
    off = option.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    return (0.0, 0.0, 0.0) if off else tuple(option.gravity.tolist())


def is_floor(kind: int) -> bool:
    """Return whether a geom of this type that is fixed to the world is a floor, which stays where its file puts it."""
    return int(kind) in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)


def compile_mjcf(mjcf: Mjcf, mjcf_robot: MjcfRobot, *, file: Path | None = None) -> mujoco.MjModel:
    """The file's own model, alone in its world.

    Raises:
        SceneError: If MuJoCo refuses it.
    """
    try:
        return mjcf.spec.compile()
    except ValueError as error:
        raise SceneError(
            f"this asset cannot be compiled: {refusal(error)}",
            key=f"robot.{mjcf_robot.robot.name}.asset",
            file=file,
            found=mjcf_robot.path,
        ) from error


_NAMED = {
    mujoco.mjtObj.mjOBJ_BODY: "bodies",
    mujoco.mjtObj.mjOBJ_XBODY: "bodies",
    mujoco.mjtObj.mjOBJ_JOINT: "joints",
    mujoco.mjtObj.mjOBJ_GEOM: "geoms",
    mujoco.mjtObj.mjOBJ_SITE: "sites",
    mujoco.mjtObj.mjOBJ_CAMERA: "cameras",
    mujoco.mjtObj.mjOBJ_TENDON: "tendons",
    mujoco.mjtObj.mjOBJ_ACTUATOR: "actuators",
}
"""What a sensor may name, and where the file lists it."""


def _drop_broken_sensors(spec: mujoco.MjSpec) -> list[str]:
    """Delete sensors of things that the file lacks; returns what is to be said about them."""
    left_out = []
    names = {kind: {item.name for item in getattr(spec, where)} for kind, where in _NAMED.items()}
    for sensor in list(spec.sensors):
        for kind, name in ((sensor.objtype, sensor.objname), (sensor.reftype, sensor.refname)):
            if name and name not in names.get(mujoco.mjtObj(int(kind)), {name}):
                what = mujoco.mjtObj(int(kind)).name.removeprefix("mjOBJ_").lower()
                left_out.append(f"sensor '{sensor.name or _sensor_kind(sensor)}': there is no {what} '{name}'")
                spec.delete(sensor)
                break
    return left_out


def _sensor_kind(sensor: mujoco.MjsSensor) -> str:
    return mujoco.mjtSensor(int(sensor.type)).name.removeprefix("mjSENS_").lower()


def _name_everything(spec: mujoco.MjSpec) -> None:
    """Give every unnamed element a name that depends on the file alone."""
    _name(spec.bodies[1:], ((body, "body0") for body in spec.bodies[1:]))
    for where in ("joints", "geoms", "sites"):
        kind = where[:-1]
        every = [(item, body.name) for body in spec.bodies for item in getattr(body, where)]
        _name([item for item, _ in every], ((item, f"{body}_{kind}") for item, body in every))
    _name(spec.tendons, ((tendon, "tendon0") for tendon in spec.tendons))
    _name(spec.actuators, ((actuator, actuator.target or "actuator0") for actuator in spec.actuators))
    sensors = [(s, f"{_sensor_kind(s)}_{s.objname}" if s.objname else _sensor_kind(s)) for s in spec.sensors]
    _name(spec.sensors, sensors)
    _name(spec.keys, ((key, f"key{i}") for i, key in enumerate(spec.keys)))


def _name(items: Iterable, wanted: Iterable[tuple[object, str]]) -> None:
    """Name unnamed items as wanted, with the first free number behind the name where it is taken."""
    taken = {item.name for item in items}
    for item, name in wanted:
        if item.name:
            continue
        stem, number = name.rstrip("0123456789") if name.endswith("0") else name, 0
        while name in taken:
            number += 1
            name = f"{stem}{number}"
        item.name = name
        taken.add(name)


def _set_root(spec: mujoco.MjSpec, robot: Robot, key: str, file: Path | None) -> None:
    """Weld free roots, or free a root that has no joint, where the scene says so."""
    roots = [body for body in spec.bodies[1:] if body.parent.name == "world"]
    free = [joint for body in roots for joint in body.joints if joint.type == FREE]
    if robot.floating is False:
        for joint in free:
            spec.delete(joint)
    if robot.floating and not free:
        if len(roots) != 1 or roots[0].joints:
            found = [joint.name for body in roots for joint in body.joints] or [body.name for body in roots]
            raise SceneError(
                "only an asset with one root body that has no joint can be made to float",
                key=f"{key}.floating",
                file=file,
                found=found,
            )
        roots[0].add_freejoint(name=f"{roots[0].name}_free")


def _add_servo(spec: mujoco.MjSpec, servo: Servo) -> None:
    """A drive's servo on one joint: the joint's forces are limited, velocity and position get an actuator."""
    joint = spec.joint(servo.joint)
    joint.actfrclimited = 1
    joint.actfrcrange = [-servo.effort, servo.effort]
    if servo.armature is not None:
        joint.armature = servo.armature
    if servo.mode == "effort":
        return  # its force is limited by the actuator itself, which is added with the engine's
    actuator = spec.add_actuator(name=f"drive_{servo.joint}", target=servo.joint)
    actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.gainprm[0] = servo.damping if servo.mode == "velocity" else servo.stiffness
    actuator.biasprm[:3] = [0.0, -servo.stiffness if servo.mode == "position" else 0.0, -servo.damping]


def _split_hinges(spec: mujoco.MjSpec) -> tuple[mujoco.MjSpec, list[str]]:
    """Return a file whose hinges of one body turn about one point, and a line about each body that was divided.

    MuJoCo has bodies whose hinges do not, Newton's joints do; ankles of dm-control's humanoid are some. The joints'
    order, and so the state, stays the same, and so does what collides.
    """
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    points = {body.name: {tuple(joint.pos) for joint in body.joints if joint.type == hinge} for body in spec.bodies}
    divided = [name for name, found in points.items() if len(found) > 1]
    if not divided:
        return spec, []
    folder = Path(spec.modelfiledir)
    for where in ("meshdir", "texturedir"):
        setattr(spec, where, str(folder / getattr(spec, where)))  # files are found from anywhere
    root = ElementTree.fromstring(spec.to_xml())
    _one_point_each(root, divided)
    lines = [f"body '{name}': hinges about different points get separate bodies" for name in divided]
    return mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode")), lines


def _one_point_each(root: ElementTree.Element, names: Collection[str]) -> None:
    """Give joints of named bodies, but for the last of each, separate bodies with almost no mass."""
    contact = ElementTree.SubElement(root, "contact")
    parents = {child: parent for parent in root.iter("body") for child in parent.findall("body")}
    for body, parent in parents.items():
        if body.get("name") not in names:
            continue
        joints = body.findall("joint")
        ElementTree.SubElement(contact, "exclude", body1=parent.get("name"), body2=body.get("name"))
        for joint in joints[:-1]:
            place = {key: body.attrib.pop(key) for key in ("pos", "quat") if key in body.attrib}
            family = {"childclass": body.get("childclass")} if "childclass" in body.attrib else {}
            own = ElementTree.Element("body", name=f"{body.get('name')}_{joint.get('name')}", **place, **family)
            own.append(ElementTree.Element("inertial", SPECK))
            body.remove(joint)
            own.append(joint)
            at = list(parent).index(body)
            parent.remove(body)
            own.append(body)
            parent.insert(at, own)
            parent = own
