# SPDX-License-Identifier: Apache-2.0
"""Findings about controls whose limits are too small for what is wanted: bounds on how far joints and frames can go."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .places import static_position, wanted_distances
from .subject import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..scene.schema_over import Success
    from .subject import Subject

SHORT, PUSHED = 1.5, 3.0
"""Multiples of the farthest that controls can move a frame or joint, and that what is pushed goes in their wake, from
which their limits are a mistake: servos overshoot, and what is pushed slides on."""


def travel_findings(subject: Subject) -> Iterator[Finding]:
    """Goals and conditions that are farther away than the limits of controls let anything go in a run."""
    success, goal, scene = subject.scene.success, subject.scene.goal, subject.scene
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
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    joints = np.where(on_joint, model.actuator_trnid[:, 0], -1)
    for a in np.flatnonzero(on_joint & (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)):
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
                partner = _welded_to(model, body)
                return np.inf if partner is None else slid + far + travel(subject, partner, at, moves)
        lever += float(np.linalg.norm(model.body_pos[body]))
        body = int(model.body_parentid[body])
    return slid + (near * (1.0 + turned) if turned < 1.0 else far)


def _welded_to(model: mujoco.MjModel, body: int) -> int | None:
    """A driven body that an equality constraint holds a free body to."""
    for e in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_WELD):
        pair = [int(model.eq_obj1id[e]), int(model.eq_obj2id[e])]
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            pair = [int(model.site_bodyid[site]) for site in pair]
        if body in pair:
            other = pair[pair[0] == body]
            joint = int(model.body_jntadr[other])
            if other and joint >= 0 and model.jnt_type[joint] >= 2:
                return other
    return None


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
