# SPDX-License-Identifier: Apache-2.0
"""Findings about joints, servos and motors.

Ranges of hinges that are likely in the wrong unit, which other findings would blame on limits of controls.

Findings about controls whose limits are too small for what is wanted: bounds on how far joints and frames can go.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...scene.errors import some
from ...scene.model.control_values import UNBOUNDED
from ...scene.model.mujoco_model import driven_joint
from .finding import Finding
from .places import static_position, wanted_distances

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...scene.model.at_start import Subject
    from ...scene.model.compiled_scene import CompiledScene
    from ...scene.schema_goal import Success

TURNS = 8.0 * np.pi
"""Range of a hinge from which it is more likely written in degrees and read as radians [rad]: four turns."""
SLIGHT = np.radians(4.1 * np.pi)
"""Range below which it is more likely written in radians and read as degrees, where most hinges of a file in degrees
have one [rad]: two full turns are 12.6 then."""


def wrong_ranges(compiled: CompiledScene) -> tuple[list[int], list[int]]:
    """Velocity coordinates of hinges whose ranges are likely in degrees, and of those likely in radians.

    Args:
        compiled: The scene, compiled.
    """
    layout, wide, slight = compiled.layout, [], []
    degrees = {file.robot.name for file in compiled.mjcf_robots if mujoco.MjSpec.from_file(file.path).compiler.degree}
    for entity in layout.entities:
        dofs = [
            int(layout.joint_qd_start[j]) + k
            for j in entity.joints
            if entity.kind == "robot"
            for k in range(int(layout.joint_dof_dim[j, 0]), int(layout.joint_dof_dim[j].sum()))
        ]
        ends = {dof: (float(layout.dof_lower[dof]), float(layout.dof_upper[dof])) for dof in dofs}
        ends = {
            dof: pair
            for dof, pair in ends.items()
            if layout.dof_coord[dof] >= 0 and -UNBOUNDED < pair[0] < pair[1] < UNBOUNDED
        }
        wide += [dof for dof, pair in ends.items() if TURNS < np.ptp(pair) < 4.0 * 360.0]
        little = [dof for dof, pair in ends.items() if np.ptp(pair) < SLIGHT]
        slight += little if entity.name in degrees and 2 * len(little) >= len(ends) else []
    return wide, slight


HINGE, FREE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_FREE)
DEGREE = float(np.degrees(1.0))
FEW, WEAK = 2, 10.0
"""Robots with as few driven joints are often meant to swing up: weak from this many times their force."""


def joint_findings(subject: Subject) -> Iterator[Finding]:
    """Ranges in the wrong unit, starts outside ranges, servos that ask for what joints cannot do, weak motors."""
    yield from _ranges(subject)
    yield from _starts(subject)
    yield from _servos(subject)
    yield from _gains(subject)
    yield from _strength(subject)


def _limited(model: mujoco.MjModel) -> np.ndarray:
    """Joints with limits that are hinges or slides."""
    return np.flatnonzero(model.jnt_limited.astype(bool) & (model.jnt_type >= 2))


def _ranges(subject: Subject) -> Iterator[Finding]:
    layout, (wide, slight) = subject.compiled.layout, wrong_ranges(subject.compiled)
    if wide:
        yield Finding(
            subject.asset_key(layout.dof_name[wide[0]]),
            f"hinge {some([layout.dof_name[dof] for dof in wide])} may turn from {layout.dof_lower[wide[0]]:.4g} to "
            f"{layout.dof_upper[wide[0]]:.4g} rad",
            'a range in degrees needs <compiler angle="degree"/> in MJCF, and radians in URDF',
        )
    if slight:
        lower, upper = np.degrees([layout.dof_lower[slight[0]], layout.dof_upper[slight[0]]])
        yield Finding(
            subject.asset_key(layout.dof_name[slight[0]]),
            f"hinge {some([layout.dof_name[dof] for dof in slight])} may turn from {lower:.3g}° to {upper:.3g}° only",
            'MJCF reads angles as degrees: give <compiler angle="radian"/> if the file has radians',
        )


def _starts(subject: Subject) -> Iterator[Finding]:
    model, data = subject.world.model, subject.start
    outside = []
    for j in _limited(model):
        at, (lower, upper) = float(data.qpos[model.jnt_qposadr[j]]), model.jnt_range[j]
        if max(lower - at, at - upper) > 0.02 * max(upper - lower, 1e-6):
            outside.append((model.joint(j).name, at, lower, upper))
    if outside:
        name, at, lower, upper = outside[0]
        hint = ": is it in degrees?" if abs(at) > 2.0 * np.pi else ""
        yield Finding(
            f"{subject.asset_key(name)}.joint_q",
            f"{some([item[0] for item in outside])} starts at {at:.4g}, outside its range of {lower:.4g} to {upper:.4g}"
            + hint,
            "give joint_q a posture within the ranges, or a keyframe",
        )


def _servos(subject: Subject) -> Iterator[Finding]:
    """Position servos of MJCF files whose control range has little to do with their hinge's range.

    Grippers on slides are often sent far beyond their range, for the force.
    """
    model = subject.world.model
    far = []
    for a in range(model.nu):
        j = driven_joint(model, a)
        position = model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE and model.actuator_biasprm[a, 1] < 0.0
        plain = j >= 0 and model.actuator_gear[a, 0] != 0.0
        same_unit = np.isclose(model.actuator_gainprm[a, 0], -model.actuator_biasprm[a, 1])
        hinge = plain and model.jnt_type[j] == HINGE and model.jnt_limited[j]
        if not (position and same_unit and model.actuator_ctrllimited[a] and hinge):
            continue
        low, high = sorted(model.actuator_ctrlrange[a] / model.actuator_gear[a, 0])
        lower, upper = model.jnt_range[j]
        ratio = (high - low) / max(upper - lower, 1e-9)
        if not 0.05 < ratio < 20.0 or high < lower or low > upper:
            sign = model.actuator_gear[a, 0] < 0.0 and -high < upper and -low > lower
            far.append((model.actuator(a).name, low, high, model.joint(j).name, lower, upper, sign))
    if far:
        name, low, high, joint, lower, upper, sign = far[0]
        degrees = ": is one of them in degrees?" if 0.3 < (high - low) / (upper - lower) / DEGREE < 3.0 else ""
        cure = 'give ctrlrange in radians, even where joint ranges are in degrees, or inheritrange="1"'
        if sign:
            degrees, cure = ": is the sign of gear wrong?", "make gear positive, or turn the sign of ctrlrange"
        yield Finding(
            f"{subject.asset_key(name)}.asset",
            f"servo {some([item[0] for item in far])} is sent {low:.4g} to {high:.4g} where joint {joint} goes from "
            f"{lower:.4g} to {upper:.4g}{degrees}",
            cure,
        )


def _gains(subject: Subject) -> Iterator[Finding]:
    """Servos that push away from where they are sent, and joints that damping speeds up."""
    model = subject.world.model
    for a in range(model.nu):
        if model.actuator_biastype[a] != mujoco.mjtBias.mjBIAS_AFFINE:
            continue
        name, bias = model.actuator(a).name, model.actuator_biasprm[a]
        if bias[1] > 0.0 or bias[2] > 0.0 or (bias[1] < 0.0 and model.actuator_gainprm[a, 0] < 0.0):
            yield Finding(
                f"{subject.asset_key(name)}.asset",
                f"servo {name} pushes away from where it is sent: gains have the wrong sign",
                "kp and kv are positive",
            )
    wrong = [model.joint(int(model.dof_jntid[i])).name for i in range(model.nv) if model.dof_damping[i] < 0.0]
    if wrong:
        yield Finding(
            f"{subject.asset_key(wrong[0])}.asset", f"joint {some(wrong)} has negative damping", "make damping positive"
        )


def _strength(subject: Subject) -> Iterator[Finding]:
    """Joints of robots with a fixed root whose motors cannot hold the start posture against gravity."""
    model, data = subject.world.model, subject.start
    force = np.zeros(model.nv)
    for a in range(model.nu):
        if (joint := driven_joint(model, a)) < 0:
            return  # tendons and sites spread forces over joints
        dof = int(model.jnt_dofadr[joint])
        limits = model.actuator_forcerange[a] if model.actuator_forcelimited[a] else (-np.inf, np.inf)
        if model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE and model.actuator_ctrllimited[a]:
            limits = np.clip(model.actuator_gainprm[a, 0] * model.actuator_ctrlrange[a], *limits)
        force[dof] += abs(model.actuator_gear[a, 0]) * float(np.max(np.abs(limits)))
    limited = model.jnt_actfrclimited.astype(bool)
    for j in np.flatnonzero(limited & (model.jnt_type >= 2)):
        dof = int(model.jnt_dofadr[j])
        force[dof] = min(force[dof], float(np.max(np.abs(model.jnt_actfrcrange[j]))))
    floating = {int(model.body_rootid[model.jnt_bodyid[j]]) for j in range(model.njnt) if model.jnt_type[j] == FREE}
    still = mujoco.MjData(model)
    still.qpos = data.qpos
    mujoco.mj_forward(model, still)
    weak, short = [], 1.0 if np.count_nonzero(force) > FEW else WEAK
    for j in range(model.njnt):
        dof, root = int(model.jnt_dofadr[j]), int(model.body_rootid[model.jnt_bodyid[j]])
        need = abs(float(still.qfrc_bias[dof] - still.qfrc_passive[dof]))
        if model.jnt_type[j] >= 2 and root not in floating and 0.0 < short * force[dof] < need:
            weak.append((model.joint(j).name, need, force[dof], model.jnt_type[j] == HINGE))
    if weak:
        name, need, there, hinge = weak[0]
        unit = "N·m" if hinge else "N"
        yield Finding(
            f"{subject.asset_key(name)}.drive",
            f"joint {some([item[0] for item in weak])} needs {need:.3g} {unit} to hold the start against gravity and "
            f"has {there:.3g} {unit}",
            "check masses (kilograms), effort limits, and whether gravity_compensation is meant",
        )


SHORT, PUSHED = 1.5, 3.0
"""Multiples of the farthest that controls can move a frame or joint, and that what is pushed goes in their wake, from
which their limits are a mistake: servos overshoot, and what is pushed slides on."""


def travel_findings(subject: Subject) -> Iterator[Finding]:
    """Goals and conditions that are farther away than the limits of controls let anything go in a run."""
    success, goal, scene = subject.scene.success, subject.scene.goal, subject.scene
    if any(wrong_ranges(subject.compiled)):
        return  # which bound what is reached, and are told
    moves = displacements(subject)
    elsewhere = {motion.name for motion in scene.motion}.union(*(phase.target for phase in scene.phase))
    elsewhere |= {"goal" for phase in scene.phase if phase.goal is not None}
    for key, frame, place, near in wanted_distances(subject) if success is not None else ():
        at, from_ = static_position(subject, place), _position(subject, frame)
        if at is None or from_ is None or place in elsewhere:
            continue
        most = travel(subject, from_[1], from_[0], moves)
        away = float(np.linalg.norm((at - from_[0])[: 2 if place in scene.flat_poses else 3])) - near
        if away > SHORT * most:
            yield _finding(subject, key, frame, most, f"{place} is {away:.3g} m away", "m")
    if goal is not None and goal.object is not None and "goal" not in elsewhere and _bounds_position(success):
        start = _position(subject, goal.object)
        near = success.distance or float(np.max(success.position or 0.0))
        away = float(np.linalg.norm(goal.position - start[0][: len(goal.position)])) - near
        tips = [
            travel(subject, body, subject.start.xpos[body], moves)
            for robot in scene.robot
            for body in subject.world.bodies.get(robot.name, ())
            if body and subject.world.model.body_weldid[body]
        ]
        if tips and away > PUSHED * max(tips):
            yield _finding(subject, "goal", "any robot", max(tips), f"{goal.object} is {away:.3g} m from its goal", "m")
    layout, model = subject.compiled.layout, subject.world.model
    for condition in success.conditions if success else ():
        if condition.joint is None or condition.joint not in layout.dof_name:
            continue
        j = _joint_of(subject, layout.dof_name.index(condition.joint))
        at = float(subject.start.qpos[model.jnt_qposadr[j]])
        above, below = (at if bound is None else bound for bound in (condition.above, condition.below))
        needed = max(above - at, at - below)
        if needed > SHORT * moves[j]:
            text = f"what is wanted is {needed:.3g} away"
            yield _finding(subject, "success.conditions", condition.joint, moves[j], text, "m or rad")


def _finding(subject: Subject, key: str, name: str, most: float, away: str, unit: str) -> Finding:
    timeout = subject.scene.timing.timeout
    return Finding(
        key,
        f"within the limits of controls {name} moves at most {most:.2g} {unit} in the {timeout:g} s of a run: {away}",
        "raise the limits of the controls (drive.limit, ctrlrange in MJCF; rad/s and m/s), or timing.timeout",
    )


def _bounds_position(success: Success | None) -> bool:
    return success is not None and (success.distance is not None or success.position is not None)


def displacements(subject: Subject) -> np.ndarray:
    """Bound on how far each joint can go from its start in a run ``[njnt]`` [m or rad]; infinite where none is known.

    Servos of velocities are sent their limit all the time, servos of positions the end of their range; nothing is known
    of joints that forces drive, or nothing does, but their range.
    """
    model, world, timeout = subject.world.model, subject.world, subject.scene.timing.timeout
    lower, upper = subject.compiled.layout.control_lower, subject.compiled.layout.control_upper
    most = np.full(model.njnt, np.inf)
    q = subject.start.qpos[model.jnt_qposadr]
    limited = model.jnt_limited.astype(bool) & (model.jnt_type >= 2)
    most[limited] = np.maximum(q - model.jnt_range[:, 0], model.jnt_range[:, 1] - q)[limited].clip(0.0)
    matrix = world.actuator_matrix
    with np.errstate(invalid="ignore"):
        reach = np.where(matrix != 0.0, 0.5 * np.abs(matrix) * (upper - lower), 0.0).sum(axis=1)
        centre = np.where(matrix != 0.0, 0.5 * matrix * (lower + upper), 0.0).sum(axis=1) + world.actuator_offset
    joints = np.array([driven_joint(model, a) for a in range(model.nu)], dtype=int)
    for a in np.flatnonzero((joints >= 0) & (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)):
        j, (offset, stiffness, damping) = int(joints[a]), model.actuator_biasprm[a, :3]
        gear, gain = float(model.actuator_gear[a, 0]), float(model.actuator_gainprm[a, 0])
        if np.count_nonzero(joints == j) > 1 or model.jnt_type[j] < 2 or not np.isfinite(reach[a]) or not gear:
            continue
        ends = np.array([centre[a] - reach[a], centre[a] + reach[a]])
        if stiffness < 0.0:
            far = np.abs((gain * ends + offset) / (-stiffness * gear) - q[j]).max()
        elif damping < 0.0:
            far = np.abs((gain * ends + offset) / (-damping * gear)).max() * timeout
        else:
            continue
        most[j] = min(most[j], far)
    return most


def travel(subject: Subject, body: int, at: np.ndarray, moves: np.ndarray) -> float:
    """Distance that a point of a body goes from its start in a run at most [m]; infinite where nothing bounds it.

    Every joint turns or slides as far as it can, and all of that adds up. A joint's lever is as at the start where
    turns are small, else the length of all links between.

    Args:
        subject: The scene.
        body: The body.
        at: Where the point is at the start ``[3]``.
        moves: Bound of each joint, as of :func:`displacements`.
    """
    model, data = subject.world.model, subject.start
    lever, slid, turned, near, far = float(np.linalg.norm(at - data.xpos[body])), 0.0, 0.0, 0.0, 0.0
    while model.body_weldid[body] != 0:
        first = int(model.body_jntadr[body])
        for j in range(first, first + int(model.body_jntnum[body])):
            if model.jnt_type[j] >= 2 and not np.isfinite(moves[j]):
                return np.inf
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE:
                turned += moves[j]
                near += moves[j] * float(np.linalg.norm(at - data.xanchor[j]))
                far += moves[j] * (lever + slid + float(np.linalg.norm(model.jnt_pos[j])))
            elif model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
                slid += moves[j]
            else:
                return np.inf
        lever += float(np.linalg.norm(model.body_pos[body]))
        body = int(model.body_parentid[body])
    return slid + (near * (1.0 + turned) if turned < 1.0 else far)


def _joint_of(subject: Subject, dof: int) -> int:
    """Joint of the model behind a velocity coordinate of the layout."""
    return int(subject.world.model.dof_jntid[subject.dof(dof)])


def _position(subject: Subject, frame: str) -> tuple[np.ndarray, int] | None:
    """Place of a frame at the start ``[3]``, and its body."""
    layout, data = subject.compiled.layout, subject.start
    index = layout.frame_name.index(frame) if frame in layout.frame_name else -1
    if index < 0 or layout.frame_body[index] < 0:
        return None
    body = subject.world.model.body(subject.compiled.body_name[layout.frame_body[index]]).id
    return data.xpos[body] + data.xmat[body].reshape(3, 3) @ layout.frame_pose[index, :3], int(body)
