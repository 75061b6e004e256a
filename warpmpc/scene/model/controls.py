# SPDX-License-Identifier: Apache-2.0
"""From a robot's drives to joint servos of the physics model and the map from controls to their targets."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from newton import JointTargetMode, JointType

from ..errors import Mistakes, SceneError
from ..schema import Drive, DriveMode, Robot, Scene
from .control_values import asset_limits, own_limits
from .mjcf_mocap import LAG

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import newton

_TARGET = {
    DriveMode.VELOCITY: JointTargetMode.VELOCITY,
    DriveMode.MOCAP: JointTargetMode.VELOCITY,
    DriveMode.DIFF_DRIVE: JointTargetMode.VELOCITY,
    DriveMode.POSITION: JointTargetMode.POSITION,
    DriveMode.EFFORT: JointTargetMode.EFFORT,
    DriveMode.ACCELERATION: JointTargetMode.EFFORT,  # Newton has none: MuJoCo's models get their own actuator
}


@dataclass
class Actuators:
    """Controls and actuators of all robots, gathered drive by drive."""

    control: list[dict] = field(default_factory=list)
    actuator: list[dict] = field(default_factory=list)

    def own(self) -> tuple[str, ...]:
        """Name of the asset's own actuator behind each control, empty for controls of drives."""
        return tuple(c.get("actuator", "") for c in self.control)

    def arrays(self) -> dict[str, object]:
        """The fields of a :class:`~warpmpc.scene.model.layout.Layout` that describe controls."""
        matrix = np.zeros((len(self.actuator), len(self.control)), dtype=np.float32)
        for row, actuator in zip(matrix, self.actuator, strict=True):
            for column, factor in actuator["row"].items():
                row[column] = factor
        return {
            "control_name": tuple(c["name"] for c in self.control),
            "control_lower": np.array([c["lower"] for c in self.control], dtype=np.float32),
            "control_upper": np.array([c["upper"] for c in self.control], dtype=np.float32),
            "control_safe": np.array([c["safe"] for c in self.control], dtype=np.int32),
            "control_brake": np.array([c.get("brake", -1) for c in self.control], dtype=np.int32),
            "actuator_dof": np.array([a["dof"] for a in self.actuator], dtype=np.int32),
            "actuator_mode": tuple(a["mode"] for a in self.actuator),
            "actuator_matrix": matrix,
            "actuator_offset": np.zeros(len(self.actuator), dtype=np.float32),
            "actuator_effort": np.array([a["effort"] for a in self.actuator], dtype=np.float32),
            "actuator_damping": np.array([a["damping"] for a in self.actuator], dtype=np.float32),
            "actuator_speed": np.array([a["speed"] for a in self.actuator], dtype=np.float32),
        }


def drive_robot(
    part: newton.ModelBuilder,
    robot: Robot,
    axes: list[str | None],
    scene: Scene,
    actuators: Actuators,
    *,
    first_coord: int,
    first_dof: int,
    mocap: Mapping[int, tuple[str, ...]] = MappingProxyType({}),
) -> None:
    """Set a robot's start joints and servos in its builder and append its controls to ``actuators``.

    Args:
        part: The robot's builder.
        robot: The robot.
        axes: Name of every joint velocity, None for those of free and ball joints.
        scene: The scene, for errors.
        actuators: Takes the controls and actuators.
        first_coord: Joint coordinates of the robots before.
        first_dof: Joint velocities of the robots before.
        mocap: Number of a drive → joints that its mocap body is put on.

    Raises:
        SceneError: If a joint name is unknown or driven twice, or a list has the wrong length.
    """
    key = f"robot.{robot.name}"
    movable = {
        name: (coord, dof) for dof, (name, coord) in enumerate(zip(axes, _coordinates(part), strict=True)) if name
    }
    follows = _followers(part, axes)
    held = {name for joints in mocap.values() for name in joints}
    own = {name: place for name, place in movable.items() if name not in held and name not in follows}
    for coord, dof in (movable[name] for name in held):
        part.joint_q[coord] = part.joint_qd[dof] = 0.0
    mistakes = Mistakes()
    with mistakes.of_part():
        _start(part, robot, own, follows, scene, key)
    for dof in range(part.joint_dof_count):
        part.joint_target_mode[dof] = int(JointTargetMode.NONE)
        part.joint_target_ke[dof] = part.joint_target_kd[dof] = 0.0
    driven: dict[str, None] = {}  # in control order
    for number, drive in enumerate(robot.drive):
        where = f"{key}.drive" + (f"[{number}]" if len(robot.drive) > 1 else "")
        if number in mocap:
            _add_drive(part, robot, drive, mocap[number], movable, scene, where, actuators, first_coord, first_dof)
            continue
        names, known = list(own) if drive.joints is None else list(drive.joints), len(mistakes.found)
        for name in names:
            with mistakes.of_part():
                if name not in own:
                    raise _unknown(name, "no such joint with one axis", follows, f"{where}.joints", scene, own)
                if name in driven:
                    raise SceneError("this joint has two drives", key=f"{where}.joints", file=scene.path, found=name)
                driven[name] = None
        if len(mistakes.found) == known:
            with mistakes.of_part():
                _add_drive(part, robot, drive, names, movable, scene, where, actuators, first_coord, first_dof)
    mistakes.raise_all()
    if robot.armature is not None:
        values = _spread(robot.armature, len(driven), f"{key}.armature", scene)
        for name, value in zip(driven, values, strict=True):
            part.joint_armature[movable[name][1]] = value


def add_own_controls(
    model: mujoco.MjModel, robot: Robot, scene: Scene, actuators: Actuators, *, first_coord: int
) -> None:
    """Append the actuators of a robot's own MJCF file to ``actuators``, as controls by the names of the file.

    Args:
        model: The file's model.
        robot: The robot.
        scene: The scene, for errors.
        actuators: Takes the controls.
        first_coord: Joint coordinates of the robots before.

    Raises:
        SceneError: If an actuator says nothing about the range of its control.
    """
    for a in range(model.nu):
        name = model.actuator(a).name
        bounds = own_limits(model, a, held=_held_coordinate(model, a, first_coord) >= 0)
        if bounds is None:
            raise SceneError(
                f"actuator '{name}' has no limits to choose controls in: give it a ctrlrange in the asset, "
                "or the robot a drive with limit = [...]",
                key=f"robot.{robot.name}.drive",
                file=scene.path,
                found=None,
            )
        lower, upper = bounds
        actuators.control.append(
            {
                "name": f"{robot.name}/{name}",
                "lower": lower,
                "upper": upper,
                "safe": _held_coordinate(model, a, first_coord),
                "actuator": f"{robot.name}/{name}",
            }
        )


def _held_coordinate(model: mujoco.MjModel, a: int, first_coord: int) -> int:
    """Joint coordinate that an actuator holds when it is its control, or -1 for those that are no position servos."""
    joint = int(model.actuator_trnid[a, 0])
    servo = (
        model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        and int(model.jnt_type[joint]) in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
        and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_gear[a, 0] == 1.0
        and model.actuator_gainprm[a, 0] > 0.0
        and model.actuator_biasprm[a, 1] == -model.actuator_gainprm[a, 0]
    )
    return first_coord + int(model.jnt_qposadr[joint]) if servo else -1


def _coordinates(part: newton.ModelBuilder) -> list[int]:
    """Joint coordinate of every joint velocity, in order; those of free and ball joints are not their own."""
    coords: list[int] = []
    for start, dims in zip(part.joint_q_start, part.joint_dof_dim, strict=True):
        coords += [int(start) + k for k in range(sum(dims))]
    return coords


def _followers(part: newton.ModelBuilder, axes: list[str | None]) -> dict[str, str]:
    """Axes of joints that mimic another → the axis that leads; the physics has a constraint for each."""
    starts = part.joint_qd_start
    return {
        axes[starts[joint] + k]: axes[starts[leader] + k]
        for joint, leader in enumerate(part.joint_mimic_joint)
        if leader >= 0
        for k in range(sum(part.joint_dof_dim[joint]))
    }


def _unknown(name: str, message: str, follows: dict, key: str, scene: Scene, allowed) -> SceneError:
    """The error about a joint that has no drive or start to be set."""
    if name in follows:
        message = f"this joint follows '{follows[name]}' (<mimic>): name that one"
    return SceneError(message, key=key, file=scene.path, found=name, allowed=list(allowed))


def _start(part: newton.ModelBuilder, robot: Robot, movable: dict, follows: dict, scene: Scene, key: str) -> None:
    """Put the joints where the scene has them, and those that mimic others where these have them."""
    free = {
        label.removeprefix(f"{robot.name}/"): int(start)
        for label, kind, start in zip(part.joint_label, part.joint_type, part.joint_q_start, strict=True)
        if kind == JointType.FREE
    }
    if isinstance(robot.joint_q, dict):
        mistakes = Mistakes()
        for name, value in robot.joint_q.items():
            numbers = value if isinstance(value, tuple) else (value,)
            with mistakes.of_part():
                if name not in movable and name not in free:
                    above = "; it is a key of the robot: write it above this table" * (name in Robot.model_fields)
                    wanted = f"no such joint with one axis, or free joint{above}"
                    raise _unknown(name, wanted, follows, f"{key}.joint_q", scene, [*movable, *free])
                if len(numbers) not in ((3, 7) if name in free else (1,)):
                    raise SceneError(
                        "needs [x, y, z] or [x, y, z, qx, qy, qz, qw]" if name in free else "needs one number",
                        key=f"{key}.joint_q.{name}",
                        file=scene.path,
                        found=value,
                    )
        mistakes.raise_all()
        for name, value in robot.joint_q.items():
            numbers = value if isinstance(value, tuple) else (value,)
            first = free[name] if name in free else movable[name][0]
            rotation = np.array(numbers[3:])
            part.joint_q[first : first + len(numbers)] = [
                *numbers[:3],
                *(rotation / max(np.linalg.norm(rotation), 1e-9)),
            ]
    elif robot.joint_q is not None:
        if len(robot.joint_q) != len(movable):
            raise SceneError(
                f"needs one value per joint, {len(movable)} in all ({', '.join(movable)})",
                key=f"{key}.joint_q",
                file=scene.path,
                found=list(robot.joint_q),
            )
        for (coord, _), value in zip(movable.values(), robot.joint_q, strict=True):
            part.joint_q[coord] = value
    for joint, leader in enumerate(part.joint_mimic_joint):
        offset, multiplier = part.joint_mimic_coeffs[joint]
        for k in range(sum(part.joint_dof_dim[joint]) if leader >= 0 else 0):
            lead = part.joint_q[part.joint_q_start[leader] + k]
            part.joint_q[part.joint_q_start[joint] + k] = offset + multiplier * lead


def _spread(values: Sequence[float], count: int, key: str, scene: Scene) -> list[float]:
    """One value for each of some joints or controls, of as many or of one for all."""
    if len(values) not in (1, count):
        raise SceneError(f"needs 1 or {count} values", key=key, file=scene.path, found=list(values))
    return list(values) * (count if len(values) == 1 else 1)


def _add_drive(
    part, robot: Robot, drive: Drive, names, movable, scene, where, actuators: Actuators, first_coord, first_dof
) -> None:
    def spread(attribute: str, count: int, values: tuple[float, ...]) -> list[float]:
        return _spread(values, count, f"{where}.{attribute}", scene)

    count = len(names)
    controls = 2 if drive.mode is DriveMode.DIFF_DRIVE else count
    if drive.limit is not None:
        upper = spread("limit", controls, drive.limit)
        lower = [-value for value in upper]
    elif drive.lower is None:
        lower, upper = asset_limits(part, drive, {name: movable[name][1] for name in names}, scene, where)
    else:
        lower, upper = spread("lower", controls, drive.lower), spread("upper", controls, drive.upper)
        if any(lo >= hi for lo, hi in zip(lower, upper, strict=True)):
            raise SceneError("lower must stay below upper", key=f"{where}.lower", file=scene.path, found=lower)
    ke = spread("stiffness", count, drive.stiffness)
    kd = spread("damping", count, drive.damping)
    if drive.mode is DriveMode.MOCAP:
        kd = [part.joint_armature[movable[name][1]] / LAG for name in names]
    effort = None if drive.effort_limit is None else spread("effort_limit", count, drive.effort_limit)
    speed = None if drive.speed_limit is None else spread("speed_limit", count, drive.speed_limit)
    accelerates = drive.mode is DriveMode.ACCELERATION

    first_control = len(actuators.control)
    labels = ["v", "ω"] if drive.mode is DriveMode.DIFF_DRIVE else names
    for i in range(controls):
        hold = drive.mode is DriveMode.POSITION
        actuators.control.append(
            {
                "name": f"{robot.name}/{labels[i]}",
                "lower": lower[i],
                "upper": upper[i],
                "safe": first_coord + movable[names[i]][0] if hold else -1,
                "brake": first_dof + movable[names[i]][1] if accelerates else -1,
            }
        )
    for i, name in enumerate(names):
        dof = movable[name][1]
        part.joint_target_mode[dof] = int(_TARGET[drive.mode])
        part.joint_target_ke[dof] = ke[i] if drive.mode is DriveMode.POSITION else 0.0
        part.joint_target_kd[dof] = 0.0 if drive.mode in (DriveMode.EFFORT, DriveMode.ACCELERATION) else kd[i]
        if effort is not None:
            part.joint_effort_limit[dof] = effort[i]
        if drive.mode is DriveMode.DIFF_DRIVE:
            sign = -1.0 if i == 0 else 1.0
            row = {
                first_control: 1.0 / drive.wheel_radius,
                first_control + 1: sign * drive.track / (2.0 * drive.wheel_radius),
            }
        else:
            row = {first_control + i: 1.0}
        speeds = drive.mode in (DriveMode.DIFF_DRIVE, DriveMode.MOCAP)
        mode = "velocity" if speeds else str(drive.mode)
        actuators.actuator.append(
            {
                "dof": first_dof + dof,
                "mode": mode,
                "row": row,
                "effort": part.joint_effort_limit[dof],
                "damping": kd[i],
                "speed": part.joint_velocity_limit[dof] if speed is None else speed[i],
            }
        )
