# SPDX-License-Identifier: Apache-2.0
"""Mocap bodies that a drive moves: on slides and hinges, so heavy that what hangs on them does not hold them back.

A weld between such a body and a hand stays as it is, and drags the hand behind it. Environments of Fetch, MetaWorld
and others place their mocap body in Python, and make it coincide with the hand; so does the drive.

Obstacles that the task moves, as mocap bodies of a MuJoCo model.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import mujoco
import numpy as np
import warp as wp

from ..errors import SceneError
from ..schema_bodies import DriveMode, Robot, Turns

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from .layout import Layout
    from .mjcf_elements import Key

LAG = 0.01
"""Time in which a driven mocap body takes on a commanded velocity [s]; shorter than a physics step it is unstable."""
_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
_ARMATURE = {_SLIDE: 1e4, _HINGE: 1e3}
"""Inertia of a driven mocap body along its joints [kg], about them [kg·m²]."""
_TURNS = {Turns.NONE: "", Turns.YAW: "z", Turns.ALL: "zyx"}
"""Axes of the hinges, the outermost first."""


def joints_of(body: str, turns: Turns) -> tuple[str, ...]:
    """Names of the joints of a driven mocap body: slides, then hinges."""
    return tuple(f"{body}_{axis}" for axis in "xyz") + tuple(f"{body}_turn_{axis}" for axis in _TURNS[turns])


def drive_mocap(
    spec: mujoco.MjSpec, robot: Robot, keys: tuple[Key, ...], file: Path | None
) -> tuple[dict[int, tuple[str, ...]], tuple[Key, ...]]:
    """Put the mocap bodies that drives move on joints, at the places where their welds are at rest at the start.

    Args:
        spec: The file, everything named; changed in place.
        robot: The robot.
        keys: Keyframes of the file.
        file: Scene file, for errors.

    Returns:
        The joints by the drive's number, and the keyframes with the joints in place of the mocap bodies.

    Raises:
        SceneError: If a drive's mocap body is unknown, not named where there are several, or driven twice.
    """
    drives = {n: drive for n, drive in enumerate(robot.drive) if drive.mode is DriveMode.MOCAP}
    if not drives:
        return {}, keys
    bodies = {n: _body_of(spec, robot, n, file) for n in drives}
    model = spec.compile()
    start = _start(model, robot, keys)
    poses = {body: _rest(spec, start, body) for body in bodies.values()}
    moved = [(key, _start(model, None, (key,))) for key in keys]
    offsets = [{body: _rest(spec, data, body)[0] - poses[body][0] for body in poses} for _, data in moved]
    for body, pose in poses.items():
        for weld in _welds(spec, body):
            if not weld.data[6:10].any():  # MuJoCo would take it from the zero of all joints
                first, second = (poses.get(n, _pose(start, n)) for n in (weld.name1, weld.name2))
                weld.data[3:10] = np.concatenate(_mul(_inverse(first), second))
        drive = next(drive for n, drive in drives.items() if bodies[n] == body)
        _on_joints(spec.body(body), pose, joints_of(body, drive.rotation), drive.within)
    joints = {n: joints_of(bodies[n], drive.rotation) for n, drive in drives.items()}
    return joints, tuple(_key(key, offset, joints, bodies) for key, offset in zip(keys, offsets, strict=True))


def _body_of(spec: mujoco.MjSpec, robot: Robot, n: int, file: Path | None) -> str:
    """Mocap body of a drive."""
    key = f"robot.{robot.name}.drive" + f".{n}" * (len(robot.drive) > 1) + ".body"
    there = [body.name for body in spec.bodies if body.mocap]
    wanted = robot.drive[n].body
    if not there:
        cure = "mode 'mocap' moves a mocap body, and this file has none: take mode 'velocity' with joints"
        raise SceneError(cure, key=key.removesuffix(".body"), file=file, found=robot.asset)
    if wanted is None and len(there) > 1:
        raise SceneError("name one of the file's mocap bodies", key=key, file=file, allowed=there)
    if wanted is not None and wanted not in there:
        raise SceneError("this file has no such mocap body", key=key, file=file, found=wanted, allowed=there)
    body = wanted or there[0]
    if any(d.mode is DriveMode.MOCAP and d.body in (None, body) for d in robot.drive[:n]):
        raise SceneError("this mocap body has two drives", key=key, file=file, found=body)
    return body


def _start(model: mujoco.MjModel, robot: Robot | None, keys: Iterable[Key]) -> mujoco.MjData:
    """Poses at a robot's start, or at the only keyframe without one."""
    data = mujoco.MjData(model)
    for key in keys:
        if robot is None or key.name == robot.keyframe:
            for name, value in key.qpos.items():
                data.joint(name).qpos = value
            for name, (*position, x, y, z, w) in key.mocap.items():
                m = model.body(name).mocapid[0]
                data.mocap_pos[m], data.mocap_quat[m] = position, (w, x, y, z)
    axes = [model.joint(j).name for j in range(model.njnt) if int(model.jnt_type[j]) in (_SLIDE, _HINGE)]
    given = {} if robot is None or robot.joint_q is None else robot.joint_q
    for name, value in (given if isinstance(given, dict) else dict(zip(axes, given, strict=False))).items():
        if name in axes and isinstance(value, float):  # what does not fit is refused where joints are set
            data.joint(name).qpos = value
    mujoco.mj_kinematics(model, data)
    return data


def _welds(spec: mujoco.MjSpec, body: str) -> list[mujoco.MjsEquality]:
    """Welds between a body and another."""
    bodies = (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY)
    welds = [e for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_WELD and e.objtype in bodies]
    return [e for e in welds if body in (e.name1, e.name2) and e.name1 and e.name2]


def _rest(spec: mujoco.MjSpec, data: mujoco.MjData, body: str) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a mocap body at which its first weld is at rest, its own without a weld.

    A weld whose file gives no relative pose is one whose two bodies coincide.
    """
    for weld in _welds(spec, body):
        relative = weld.data[3:6].copy(), weld.data[6:10] if weld.data[6:10].any() else np.array([1.0, 0.0, 0.0, 0.0])
        if weld.name1 == body:
            return _mul(_pose(data, weld.name2), _inverse(relative))
        return _mul(_pose(data, weld.name1), relative)
    return _pose(data, body)


def _pose(data: mujoco.MjData, body: str) -> tuple[np.ndarray, np.ndarray]:
    return data.body(body).xpos.copy(), data.body(body).xquat.copy()


def _mul(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    position, rotation = np.empty(3), np.empty(4)
    mujoco.mju_mulPose(position, rotation, *a, *b)
    return position, rotation


def _inverse(a: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    position, rotation = np.empty(3), np.empty(4)
    mujoco.mju_negPose(position, rotation, *a)
    return position, rotation


def _on_joints(
    body: mujoco.MjsBody, pose: tuple[np.ndarray, np.ndarray], names: tuple[str, ...], within: tuple | None
) -> None:
    """An ordinary body at a pose, on joints along and about the axes of the file."""
    body.mocap = False
    body.pos, body.quat = pose
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.explicitinertial, body.gravcomp = True, 1.0
    body.mass, body.ipos, body.iquat, body.inertia = 1.0, np.zeros(3), [1.0, 0.0, 0.0, 0.0], np.full(3, 0.01)
    body.fullinertia[0] = np.nan
    back = pose[1] * [1.0, -1.0, -1.0, -1.0]
    for n, name in enumerate(names):
        axis, kind = np.empty(3), _SLIDE if n < 3 else _HINGE
        mujoco.mju_rotVecQuat(axis, np.eye(3)["xyz".index(name[-1])], back)
        joint = body.add_joint(name=name, type=kind, axis=axis, armature=_ARMATURE[kind])
        joint.limited = joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.damping, joint.stiffness = np.zeros_like(joint.damping), np.zeros_like(joint.stiffness)
        joint.frictionloss = joint.ref = 0.0
        if within is not None and n < 3:
            joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, [corner[n] - pose[0][n] for corner in within]
            joint.solref_limit = [LAG, 1.0]


def _key(key: Key, offset: dict[str, np.ndarray], joints: dict[int, tuple[str, ...]], bodies: dict[int, str]) -> Key:
    """A keyframe whose driven mocap bodies stand where their welds are at rest in it, turned as at the start."""
    qpos, qvel, mocap = dict(key.qpos), dict(key.qvel), dict(key.mocap)
    for n, names in joints.items():
        del mocap[bodies[n]]
        for k, name in enumerate(names):
            qpos[name], qvel[name] = (float(offset[bodies[n]][k]) if k < 3 else 0.0,), (0.0,)
    return replace(key, qpos=qpos, qvel=qvel, mocap=mocap)


def movable_body(name: str) -> str:
    """Name of the mocap body that a movable obstacle is."""
    return f"movable/{name}"


def start_poses(layout: Layout) -> np.ndarray:
    """Poses of the movable obstacles at the start ``[n, 7]``."""
    poses = [layout.shapes[entity.shapes[0]].pose for entity in layout.entities if entity.movable]
    return np.array(poses, dtype=np.float32).reshape(-1, 7)


def with_movable(mjcf: str, layout: Layout, geoms: Sequence[str]) -> str:
    """An MJCF model whose movable obstacles are mocap bodies.

    Args:
        mjcf: The model, in which they are geoms of the world.
        layout: Layout of what is in it.
        geoms: Geom of each of the layout's shapes.
    """
    if not layout.movable:
        return mjcf
    root = ElementTree.fromstring(mjcf)
    world = root.find("worldbody")
    for name, pose in zip(layout.movable, start_poses(layout), strict=True):
        geom = next(g for g in world.iter("geom") if g.get("name") == geoms[layout.entity(name).shapes[0]])
        world.remove(geom)
        at = wp.transform(*pose)
        local = wp.transform_inverse(at) * wp.transform(
            wp.vec3(*_numbers(geom, "pos", (0.0, 0.0, 0.0))), _rotation(geom)
        )
        body = ElementTree.SubElement(world, "body", {"name": movable_body(name), "mocap": "true", **_movable_pose(at)})
        geom.attrib.update(_movable_pose(local))
        body.append(geom)
    return ElementTree.tostring(root, encoding="unicode")


def _numbers(geom: ElementTree.Element, key: str, default: Sequence[float]) -> list[float]:
    return [float(x) for x in geom.get(key).split()] if key in geom.attrib else list(default)


def _rotation(geom: ElementTree.Element) -> wp.quat:
    w, x, y, z = _numbers(geom, "quat", (1.0, 0.0, 0.0, 0.0))
    return wp.normalize(wp.quat(x, y, z, w))


def _movable_pose(at: wp.transform) -> dict[str, str]:
    x, y, z, w = at.q
    return {"pos": " ".join(map(repr, map(float, at.p))), "quat": " ".join(repr(float(c)) for c in (w, x, y, z))}
