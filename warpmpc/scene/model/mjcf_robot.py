# SPDX-License-Identifier: Apache-2.0
"""An MJCF robot in the scene: its links in the builder, its controls, frames, sensors, keyframes and mocap bodies."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import mujoco
import newton
import numpy as np
import warp as wp
from newton import JointTargetMode, JointType

from ..errors import Mistakes, SceneError
from .controls import Actuators, add_own_controls, drive_robot
from .importers import given_frames
from .layout import IDENTITY, WORLD, Entity, Keyframe
from .mjcf import Mjcf, MjcfRobot, Servo, compile_mjcf, gravity_of, origin_of, read_mjcf
from .mjcf_elements import Key, keep_limits
from .mjcf_links import add_links, pose

if TYPE_CHECKING:
    from pathlib import Path

    from ..schema import Robot, Scene

_MODES = {JointTargetMode.VELOCITY: "velocity", JointTargetMode.POSITION: "position", JointTargetMode.EFFORT: "effort"}


@dataclass(frozen=True)
class _Row:
    """A keyframe of one robot in Newton's conventions, and where its numbers stand among the scene's."""

    name: str
    values: dict[str, tuple[int, np.ndarray]]
    """Field of :class:`Keyframe` → first index and values."""


@dataclass
class MjcfRobots:
    """The MJCF robots of a scene and what their files bring beyond joints and bodies, gathered robot by robot."""

    robots: list[MjcfRobot] = field(default_factory=list)
    activations: list[str] = field(default_factory=list)
    mocap: dict[str, int] = field(default_factory=dict)
    """Mocap body → its index among the bodies of the scene."""
    mocap_pose: list[tuple[float, ...]] = field(default_factory=list)
    sensors: list[tuple[str, int]] = field(default_factory=list)
    """Sensors and how many numbers they show."""
    rows: list[_Row] = field(default_factory=list)
    chosen: list[_Row] = field(default_factory=list)
    """Keyframes that robots start in."""
    gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
    """Gravity's acceleration, that of the first file [m/s²]."""
    repaired: list[str] = field(default_factory=list)
    """What is not as the files say."""
    notes: list[str] = field(default_factory=list)
    """What was taken over from the files and what was not."""

    def arrays(self, start: dict[str, np.ndarray], controls: int) -> dict[str, object]:
        """The fields of a :class:`~warpmpc.scene.model.layout.Layout` that describe them.

        Args:
            start: ``joint_q`` and ``joint_qd`` of the scene's start.
            controls: Number of controls of the scene.
        """
        start = {
            **start,
            "act": np.zeros(len(self.activations), dtype=np.float32),
            "control": np.zeros(controls, dtype=np.float32),
            "mocap": np.array(self.mocap_pose, dtype=np.float32).ravel(),
        }
        for row in self.chosen:
            for name in ("act", "control", "mocap"):
                first, values = row.values[name]
                start[name][first : first + len(values)] = values
        dims = np.array([dim for _, dim in self.sensors], dtype=np.int32)
        return {
            "activation_name": tuple(self.activations),
            "act": start["act"],
            "control_start": start["control"] if self.chosen else np.zeros(0, dtype=np.float32),
            "mocap_name": tuple(self.mocap),
            "mocap_body": np.array(list(self.mocap.values()), dtype=np.int32),
            "mocap": start["mocap"].reshape(-1, 7),
            "sensor_name": tuple(name for name, _ in self.sensors),
            "sensor_start": (np.cumsum(dims) - dims).astype(np.int32),
            "sensor_dim": dims,
            "gravity": self.gravity,
            "keyframes": tuple(_keyframe(row, start) for row in self.rows),
        }


def _keyframe(row: _Row, start: dict[str, np.ndarray]) -> Keyframe:
    """A keyframe of the whole scene: all that is not the robot's own stands at the start."""
    whole = {name: values.copy() for name, values in start.items()}
    for name, (first, values) in row.values.items():
        whole[name][first : first + len(values)] = values
    return Keyframe(row.name, **{name: tuple(values.tolist()) for name, values in whole.items()})


def add_mjcf_robot(
    builder: newton.ModelBuilder,
    part: newton.ModelBuilder,
    robot: Robot,
    path: Path,
    scene: Scene,
    frames: dict,
    actuators: Actuators,
    axes: list[str],
    mjcf_robots: MjcfRobots,
) -> Entity:
    """Add an MJCF robot to the builder of a scene.

    Args:
        builder: Builder of the scene.
        part: Empty builder for the robot.
        robot: The robot.
        path: Its file.
        scene: The scene, for errors and drives.
        frames: Takes the robot's bodies and sites.
        actuators: Takes its controls.
        axes: Takes the names of its joint velocities.
        mjcf_robots: Takes what else the file brings.

    Raises:
        SceneError: If the file cannot be taken over, or the scene names what it lacks.
    """
    name, first_body = robot.name, builder.body_count
    mjcf_robot = MjcfRobot(str(path), robot)
    mjcf = read_mjcf(mjcf_robot, file=scene.path)
    model = compile_mjcf(mjcf, mjcf_robot, file=scene.path)
    if not mjcf_robots.robots:
        mjcf_robots.gravity = gravity_of(model.opt)
    led = [joint for joints in mjcf.mocap.values() for joint in joints]
    origin = origin_of(robot, model, next((key for key in mjcf.keys if key.name == robot.keyframe), None), led)
    place = wp.transform(wp.vec3(*origin[:3]), wp.quat(*origin[3:]))
    links = add_links(part, model, robot, place, file=scene.path)
    bodies = [model.body(b).name for b in range(1, model.nbody)]
    first = {
        "joint_q": builder.joint_coord_count,
        "joint_qd": builder.joint_dof_count,
        "act": len(mjcf_robots.activations),
        "control": len(actuators.control),
        "mocap": 7 * len(mjcf_robots.mocap),
    }
    rows = [_row(part, model, robot, place, key, first) for key in mjcf.keys]
    if robot.keyframe is not None:
        row = next((r for r in rows if r.name == f"{name}/{robot.keyframe}"), None)
        if row is None:
            raise SceneError(
                "this asset has no such keyframe",
                key=f"robot.{name}.keyframe",
                file=scene.path,
                found=robot.keyframe,
                allowed=[key.name for key in mjcf.keys],
            )
        part.joint_q[:], part.joint_qd[:] = (row.values[n][1].tolist() for n in ("joint_q", "joint_qd"))
        mjcf_robots.chosen.append(row)
    mjcf_robots.rows += rows
    axes += [f"{name}/{axis}" if axis else "" for axis in links.axes]
    if robot.keeps_actuators:
        add_own_controls(model, robot, scene, actuators, first_coord=first["joint_q"])
        for a in range(model.nu):
            mjcf_robots.activations += [f"{name}/{model.actuator(a).name}"] * int(model.actuator_actnum[a])
    keep_limits(part, links.axes, mjcf.motors)
    mistakes, firsts = Mistakes(), {"first_coord": first["joint_q"], "first_dof": first["joint_qd"]}
    with mistakes.of_part():
        drive_robot(part, robot, links.axes, scene, actuators, **firsts, mocap=mjcf.mocap)
    with mistakes.of_part():
        given = given_frames(robot, bodies, first_body, scene)
    mistakes.raise_all()
    servos = _servos(part, robot, links.axes) if robot.drive else ()
    for b in links.mocap:
        at = wp.transform(*part.joint_X_p[part.joint_child.index(b)])
        mjcf_robots.mocap[f"{name}/{bodies[b]}"] = first_body + b
        mjcf_robots.mocap_pose.append((*at.p, *at.q))
    mjcf_robots.sensors += [(f"{name}/{model.sensor(s).name}", int(model.sensor_dim[s])) for s in range(model.nsensor)]
    mjcf_robot = MjcfRobot(str(path), robot, servos, origin)
    mjcf_robots.robots.append(mjcf_robot)

    first_shape, first_joint = builder.shape_count, builder.joint_count
    builder.add_builder(part)
    clashes = _add_frames(frames, model, robot, place, given, first_body, bodies)
    mjcf_robots.repaired += [f"{name}: {line}" for line in mjcf.repaired]
    mjcf_robots.notes += _notes(model, mjcf, mjcf_robot, links.left_out, clashes)
    return Entity(
        name,
        "robot",
        bodies=tuple(range(first_body, builder.body_count)),
        shapes=tuple(range(first_shape, builder.shape_count)),
        joints=tuple(range(first_joint, builder.joint_count)),
    )


def _row(
    part: newton.ModelBuilder, model: mujoco.MjModel, robot: Robot, place: wp.transform, key: Key, first: dict[str, int]
) -> _Row:
    """A keyframe in Newton's conventions, in a file whose origin has a place in the scene."""
    q, qd = np.zeros(part.joint_coord_count), np.zeros(part.joint_dof_count)
    for joint, child in enumerate(part.joint_child):
        start, dof = part.joint_q_start[joint], part.joint_qd_start[joint]
        adr, count = model.body_jntadr[child + 1], model.body_jntnum[child + 1]
        names = [model.joint(j).name for j in range(adr, adr + count)]
        if part.joint_type[joint] == JointType.FREE:
            at = place * pose(key.qpos[names[0]][:3], key.qpos[names[0]][3:])
            omega = wp.quat_rotate(at.q, wp.vec3(*key.qvel[names[0]][3:]))
            arm = wp.quat_rotate(at.q, wp.vec3(*part.body_com[child]))
            velocity = wp.quat_rotate(place.q, wp.vec3(*key.qvel[names[0]][:3])) + wp.cross(omega, arm)
            q[start : start + 7], qd[dof : dof + 6] = [*at.p, *at.q], [*velocity, *omega]
        elif part.joint_type[joint] == JointType.BALL:
            w, x, y, z = key.qpos[names[0]]
            q[start : start + 4] = x, y, z, w
            qd[dof : dof + 3] = wp.quat_rotate(wp.quat(x, y, z, w), wp.vec3(*key.qvel[names[0]]))
        else:
            for k, name in enumerate(names):
                q[start + k], qd[dof + k] = key.qpos[name][0], key.qvel[name][0]
    poses = [place * wp.transform(wp.vec3(*at[:3]), wp.quat(*at[3:])) for at in key.mocap.values()]
    own = robot.keeps_actuators
    values = {
        "joint_q": q,
        "joint_qd": qd,
        "act": np.array([x for entry in key.act.values() for x in entry] if own else []),
        "control": np.array(list(key.ctrl.values()) if own else []),
        "mocap": np.array([[*at.p, *at.q] for at in poses]).ravel(),
    }
    return _Row(f"{robot.name}/{key.name}", {n: (first[n], v) for n, v in values.items()})


def _servos(part: newton.ModelBuilder, robot: Robot, axes: list[str | None]) -> tuple[Servo, ...]:
    """The servos that the robot's drives put on its joints."""
    servos = []
    for dof, name in enumerate(axes):
        mode = _MODES.get(JointTargetMode(part.joint_target_mode[dof]))
        if name and mode:
            servos.append(
                Servo(
                    name,
                    mode,
                    float(part.joint_target_ke[dof]),
                    float(part.joint_target_kd[dof]),
                    float(part.joint_effort_limit[dof]),
                    None if robot.armature is None else float(part.joint_armature[dof]),
                )
            )
    return tuple(servos)


def _add_frames(
    frames: dict, model: mujoco.MjModel, robot: Robot, place: wp.transform, given: dict, first: int, bodies: list[str]
) -> list[str]:
    """Add bodies, sites and the scene's own frames; returns the sites that have a body's name, and get another."""
    frames.update({f"{robot.name}/{body}": (first + i, IDENTITY) for i, body in enumerate(bodies)})
    heavy = [b for b in range(1, model.nbody) if model.body_mass[b] > 0.0]
    if heavy:
        frames[robot.name] = (first + heavy[0] - 1, IDENTITY)
    clashes = []
    for s in range(model.nsite):
        name, body = model.site(s).name, int(model.site_bodyid[s]) - 1
        if name in bodies:
            clashes.append(name)
            name = f"{name}_site"
        at = pose(model.site_pos[s], model.site_quat[s])
        at = at if body >= 0 else place * at
        frames[f"{robot.name}/{name}"] = (first + body if body >= 0 else WORLD, (*at.p, *at.q))
    frames.update(given)
    return clashes


def _notes(
    model: mujoco.MjModel, mjcf: Mjcf, mjcf_robot: MjcfRobot, left_out: list[str], clashes: list[str]
) -> list[str]:
    """Notes on what was taken over from a file and what was not, one line each."""
    robot = mjcf_robot.robot
    counts = {
        "body": model.nbody - 1,
        "joint": model.njnt,
        "geom": model.ngeom,
        "site": model.nsite,
        "actuator": model.nu if robot.keeps_actuators else 0,
        "activation": model.na if robot.keeps_actuators else 0,
        "tendon": model.ntendon,
        "equality": model.neq,
        "contact exclude": model.nexclude,
        "contact pair": model.npair,
        "sensor": model.nsensor,
        "keyframe": len(mjcf.keys),
        "mocap body": model.nmocap,
    }
    taken = ", ".join(f"{n} {_plural(what, n)}" for what, n in counts.items() if n)
    changed = []
    if mjcf.mocap:
        changed.append("mocap bodies that drives move are bodies on joints, at their welds' rest")
    changed += mjcf.replaced
    if robot.floating is False and not any(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        changed.append("its root is fixed, as the scene says")
    if robot.self_collision is False:
        changed.append("its links do not collide with each other, as the scene says")
    if clashes:
        changed.append(f"sites that share a body's name are frames with _site behind it: {', '.join(clashes)}")
    pictures = {"camera": model.ncam, "light": model.nlight, "skin": model.nskin}
    left_out = [*mjcf.left_out, *left_out]
    left_out += [f"{n} {_plural(what, n)}: for pictures alone" for what, n in pictures.items() if n]
    if model.nflex:
        left_out.append(f"{model.nflex} {_plural('flex', model.nflex)}: simulated, but not drawn and not seen by terms")
    return [f"{robot.name}: {taken}", *(f"{robot.name}: {line}" for line in changed)] + [
        f"{robot.name}: not taken over: {line}" for line in left_out
    ]


def _plural(what: str, count: int) -> str:
    if count == 1:
        return what
    return what[:-1] + "ies" if what.endswith("y") else what + ("es" if what.endswith("x") else "s")
