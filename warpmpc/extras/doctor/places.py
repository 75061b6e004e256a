# SPDX-License-Identifier: Apache-2.0
"""Findings about places: goals inside obstacles, under the ground, or beyond the reach of a robot that stands fast.

Samples of a plan: how near they come to what success asks for, and frames that no sample moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...scene.errors import some
from ...scene.model.overlaps import DEEP
from ...scene.task.conditions import StateSnapshot
from .control import PROBES, driven_frames, names_in
from .finding import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...loop.plant.monitor import Monitor
    from ...planner.controller.controller import Controller
    from ...planner.plan import Rollout
    from ...scene.model.at_start import Subject
    from ...scene.task.goal import Comparison

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
BEYOND = 1.05
"""Share of its reach from which a place counts as out of it: the reach is that of a stretched arm without limits."""
LED_TO = 1.25
"""The same of places that a term leads to: as far as a frame goes may be all that is meant."""
GEOM = mujoco.mjtGeom


def place_findings(subject: Subject) -> Iterator[Finding]:
    """Goals that cannot be reached, and places that a term or condition leads a robot to in vain."""
    yield from _under_ground(subject)
    yield from _inside(subject)
    yield from _beyond(subject)


def _under_ground(subject: Subject) -> Iterator[Finding]:
    goal, ground = subject.scene.goal, subject.scene.ground
    if goal is not None and ground is not None and len(goal.position) == 3:
        depth = ground.height - goal.position[2]
        if depth > DEEP:
            yield Finding(
                "goal.position",
                f"the goal of {goal.target} lies {depth:.3g} m under the ground",
                "raise its third number",
            )


def reach(subject: Subject, frame: str) -> tuple[np.ndarray, float] | None:
    """Centre ``[3]`` and radius [m] of a sphere that a frame of a robot cannot leave; None where there is none."""
    layout, model = subject.compiled.layout, subject.world.model
    index = layout.frame_name.index(frame) if frame in layout.frame_name else -1
    if index < 0 or layout.frame_body[index] < 0:
        return None
    body = model.body(subject.compiled.body_name[layout.frame_body[index]]).id
    radius, root = float(np.linalg.norm(layout.frame_pose[index, :3])), 0
    while model.body_weldid[body] != 0:
        for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            if model.jnt_type[j] == SLIDE and model.jnt_limited[j]:
                radius += float(np.abs(model.jnt_range[j] - model.qpos0[model.jnt_qposadr[j]]).max())
            elif model.jnt_type[j] not in (HINGE, int(mujoco.mjtJoint.mjJNT_BALL)):
                return None
            radius += 2.0 * float(np.linalg.norm(model.jnt_pos[j]))
        root, body = body, int(model.body_parentid[body])
        if model.body_weldid[body] != 0:
            radius += float(np.linalg.norm(model.body_pos[root]))
    if not root:
        return None
    data = subject.start
    return data.xpos[body] + data.xmat[body].reshape(3, 3) @ model.body_pos[root], radius


def _beyond(subject: Subject) -> Iterator[Finding]:
    """Frames that are to come near a place which they cannot reach."""
    scene, asked = subject.scene, list(wanted_distances(subject))
    for cost in scene.cost:
        between = cost.params.get("between")
        if cost.term == "distance" and isinstance(between, list | tuple) and len(between) == 2:
            if all(name == "goal" or static_position(subject, name) is not None for name in between):
                yield Finding(
                    f"cost.{cost.name or cost.term}",
                    f"neither {between[0]} nor {between[1]} is moved by any control: this term never changes",
                    "name what is to move (a frame of a robot, an object)",
                )
            asked += [(f"cost.{cost.name or cost.term}", *pair, 0.0) for pair in (between, between[::-1])]
    seen = set()
    for key, frame, place, near in asked:
        at, sphere = static_position(subject, place), reach(subject, frame)
        if at is None or sphere is None or (frame, place) in seen:
            continue
        away = float(np.linalg.norm(at - sphere[0]))
        if away - near > (LED_TO if key.startswith("cost.") else BEYOND) * sphere[1]:
            seen.add((frame, place))
            yield Finding(
                key,
                f"{place} is {away:.3g} m from the base of {frame}, which reaches {sphere[1]:.3g} m at most",
                "move the place or the robot, name the robot that is near, or check units (metres)",
            )


def wanted_distances(subject: Subject) -> Iterator[tuple[str, str, str, float]]:
    """Key, frame, place and distance [m] of what success asks for: the goal of a frame, and its conditions."""
    goal, success = subject.scene.goal, subject.scene.success
    counts = success is None or success.distance is not None or success.position is not None
    if goal is not None and len(goal.position) == 3 and goal.object is None and counts:
        near = success.distance or float(np.max(success.position or 0.0)) if success else 0.0
        yield "goal.position", goal.target, "goal", near
    for condition in success.conditions if success else ():
        if condition.frame is not None and condition.distance is not None:
            yield "success.conditions", condition.frame, condition.to, condition.distance


def static_position(subject: Subject, name: str) -> np.ndarray | None:
    """Position ``[3]`` of what never moves: the goal, a target, an obstacle."""
    scene = subject.scene
    if name == "goal":
        goal = scene.goal
        return np.array(goal.position) if goal is not None and len(goal.position) == 3 else None
    for item in (*scene.target, *scene.obstacle):
        if item.name == name and len(item.position) == 3:
            return np.array(item.position)
    return None


def _inside(subject: Subject) -> Iterator[Finding]:
    """A goal inside an obstacle."""
    goal, model, world = subject.scene.goal, subject.world.model, subject.world
    if goal is None:
        return
    data = mujoco.MjData(model)
    data.qpos, data.mocap_pos, data.mocap_quat = subject.start.qpos, subject.start.mocap_pos, subject.start.mocap_quat
    mujoco.mj_forward(model, data)
    place = np.array([*goal.position, 0.0][:3])
    if goal.object is not None:
        body = next((b for b in world.bodies.get(goal.object, ()) if b), 0)
        joint = int(model.body_jntadr[body]) if body else -1
        if joint < 0 or model.jnt_type[joint] != 0:
            return
        first = int(model.jnt_qposadr[joint])
        place[2] = goal.position[2] if len(goal.position) == 3 else data.qpos[first + 2]
        data.qpos[first : first + 3] = place
        mujoco.mj_forward(model, data)
        own = set(world.geoms.get(goal.object, ()))
    elif len(goal.position) < 3:
        return
    for entity in subject.compiled.layout.entities:
        if entity.kind != "obstacle":
            continue
        geoms = set(world.geoms.get(entity.name, ()))
        if goal.object is not None:
            inside = any(
                contact.dist < -DEEP and {int(contact.geom[0]) in own, int(contact.geom[1]) in own} == {True, False}
                for contact in data.contact[: data.ncon]
                if geoms & {int(contact.geom[0]), int(contact.geom[1])}
            )
        else:
            inside = any(_contains(model, data, g, place) for g in geoms)
        if inside:
            yield Finding(
                "goal.position",
                f"the goal of {goal.target} lies inside the obstacle {entity.name}: it cannot be reached",
                "move the goal or the obstacle",
            )


def _contains(model: mujoco.MjModel, data: mujoco.MjData, g: int, point: np.ndarray) -> bool:
    """True for a point inside a box, sphere, capsule, cylinder or ellipsoid."""
    x, size, kind = (
        data.geom_xmat[g].reshape(3, 3).T @ (point - data.geom_xpos[g]),
        model.geom_size[g],
        model.geom_type[g],
    )
    if kind == GEOM.mjGEOM_BOX:
        return bool(np.all(np.abs(x) < size))
    if kind == GEOM.mjGEOM_SPHERE:
        return bool(np.linalg.norm(x) < size[0])
    if kind == GEOM.mjGEOM_ELLIPSOID:
        return bool(np.linalg.norm(x / size) < 1.0)
    if kind == GEOM.mjGEOM_CYLINDER:
        return bool(np.hypot(*x[:2]) < size[0] and abs(x[2]) < size[1])
    if kind == GEOM.mjGEOM_CAPSULE:
        return bool(np.linalg.norm([*x[:2], max(abs(x[2]) - size[1], 0.0)]) < size[0])
    return False


NOISE = 1e-3
"""Share of the way to its bound by which a sample must come nearer than the start, or it counts as no nearer."""
STILL = 1e-4
"""Movement that counts as none [m or rad]."""


@dataclass(frozen=True)
class Approach:
    """A number that success waits for, at the start and where a sample came nearest to its bound."""

    start: Comparison
    best: Comparison

    @property
    def nearer(self) -> bool:
        """True where it holds at the start, or a sample comes nearer by more than noise, or that is unknown."""
        return (
            np.isnan(self.start.value)
            or self.start.holds
            or self.best.excess < self.start.excess - NOISE * abs(self.start.excess)
        )


def probes(controller: Controller) -> list[Rollout]:
    """Rollouts of samples of the last plan that did not diverge; at most ``PROBES``."""
    costs = controller.engine.cost.numpy()[0]
    chosen = np.unique(np.linspace(0, controller.shape.samples - 1, PROBES).astype(int))
    return [controller.rollout(int(k)) for k in chosen if np.isfinite(costs[k])]


def approaches(rollouts: list[Rollout], monitor: Monitor) -> list[Approach]:
    """Conditions of success, or of the end of the first phase, in rollouts; cost terms have no values there (NaN)."""
    states = [state for rollout in rollouts for state in zip(rollout.body_q, rollout.joint_q, strict=True)]
    compared = (monitor.compared(StateSnapshot(body_q, joint_q, {})) for body_q, joint_q in states)
    return [Approach(seen[0], min(seen, key=lambda new: new.excess)) for seen in zip(*compared, strict=True)]


def still_findings(subject: Subject, rollouts: list[Rollout]) -> Iterator[Finding]:
    """Frames and joints of driven robots that a term, goal or condition is about and that no sample moves.

    Objects, and what a robot has to touch first, may well stand still in all samples.
    """
    scene, layout = subject.scene, subject.compiled.layout
    if not rollouts:
        return
    poses = np.array([rollout.body_q for rollout in rollouts])
    still = np.ptp(poses, axis=(0, 1)).max(axis=-1) < STILL
    bodies = dict(zip(layout.frame_name, layout.frame_body, strict=True))
    at_rest = {name for name in driven_frames(subject) if still[bodies[name]]} - {robot.name for robot in scene.robot}
    asked = [(f"cost.{cost.name or cost.term}", names_in(cost.params)) for cost in scene.cost]
    if scene.goal is not None:
        asked.append(("goal", {scene.goal.target}))
    asked += [
        ("success.conditions", {condition.frame, condition.to})
        for condition in (scene.success.conditions if scene.success else ())
    ]
    named = {key: sorted(names & at_rest) for key, names in asked if names & at_rest}
    if named:
        (key, names), ahead = next(iter(named.items())), float(np.ptp(rollouts[0].times))
        yield Finding(
            key,
            f"no sample of a plan moves {some(names)} within {ahead:.3g} s",
            "check damping, frictionloss, gains and limits of the joints that carry it, and that nothing holds it",
        )
