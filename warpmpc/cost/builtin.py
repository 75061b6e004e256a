# SPDX-License-Identifier: Apache-2.0
"""The built-in cost terms: how their keys in scene files become kernel parameters."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.terms import (
    clearance,
    grasping,
    pushing,
)
from ..kernels.terms import (
    general as costs,
)
from ..scene.errors import SceneError
from . import arm, cloud, collision, components, gait, learned, numbers, residuals, rolling
from .binding import PRIMITIVES
from .joints import dof_names, joint_dofs, named_dofs, robot_range
from .keys import (
    Approach,
    ContactForce,
    Distance,
    FingerAlignment,
    Gripper,
    Height,
    JointLimit,
    Joints,
    Metric,
    ObstacleClearance,
    Orientation,
    OutlineClearance,
    OutlineDistance,
    PushAlignment,
    PushPath,
    Robots,
    Yaw,
)
from .native import clearance as native_clearance
from .native import pushing as native_pushing
from .resources.geodesic import convex_outline, obstacle_outlines, outline
from .resources.guide import Guides
from .resources.push_path import PushRequest
from .resources.push_value import PushValues
from .term import CostTerm, parse_keys

if TYPE_CHECKING:
    from .binding import Binding


def _distance(keys: dict[str, Any], b: Binding) -> costs.DistanceParams:
    v = parse_keys(Distance, keys, b)
    p = costs.DistanceParams()
    p.first, p.second = (b.frame(name, "between") for name in v.between)
    p.planar = int(v.planar or bool(b.scene.flat_poses & {*v.between}) or v.metric is Metric.GEODESIC)
    p.field, p.near, p.lead = -1, v.near, v.lead
    if v.metric is Metric.GEODESIC:
        b.require_still("metric")
        inflation = b.footprint(v.between[0]) if v.inflation is None else v.inflation
        p.field = b.resources.get(Guides).request(p, p.second, inflation)
    return p


def _yaw(keys: dict[str, Any], b: Binding) -> costs.YawParams:
    v = parse_keys(Yaw, keys, b)
    p = costs.YawParams()
    p.of, p.to, p.near, p.smooth = b.frame(v.of, "of"), b.frame(v.to, "to"), v.near, v.smooth
    return p


def _push_alignment(keys: dict[str, Any], b: Binding) -> pushing.PushAlignmentParams:
    v = parse_keys(PushAlignment, keys, b)
    p = pushing.PushAlignmentParams()
    p.pusher, p.object, p.goal = b.frame(v.pusher, "pusher"), b.frame(v.object, "object"), b.frame(v.goal, "goal")
    p.near, p.slack, p.field = v.near, v.slack, -1
    if v.metric is Metric.GEODESIC:
        b.require_still("metric")
        inflation = b.footprint(v.object) if v.inflation is None else v.inflation
        p.field = b.resources.get(Guides).request(p, p.goal, inflation)
    return p


_LEAST_ARM = 0.4
"""A place to turn a box from is at least this far beside the middle of a broad side [rad], for broad pushers."""


def _push_path(keys: dict[str, Any], b: Binding) -> pushing.PushPathParams:
    v = parse_keys(PushPath, keys, b)
    b.require_still()
    shape = b.object_shape(v.object, "object")
    p = pushing.PushPathParams()
    p.pusher, p.object = b.frame(v.pusher, "pusher"), b.frame(v.object, "object")
    x, y = shape.scale[0], shape.scale[1 if shape.kind == "box" else 0]
    inflation = b.footprint(v.object) if v.inflation is None else v.inflation
    p.goal, p.tolerance = b.frame("goal", "goal"), v.tolerance
    p.broad = 0.0 if y >= x else 0.5 * math.pi
    # so far out that the pusher's side reaches three quarters of the way to the corner
    p.arm = max(_LEAST_ARM, math.atan2(0.75 * max(x, y) - 0.5 * v.width, min(x, y)))
    p.aim = wp.vec2(0.75 * min(p.arm, math.atan2(min(x, y), max(x, y))), 0.75 * p.arm)
    p.faces, p.steer, p.lead = int(shape.kind == "box"), v.steer, v.lead
    p.through = int(v.through and v.lead > 0.0)
    # to a centimetre, so that a distance term can share the field
    p.field = b.resources.get(Guides).request(p, p.object, round(0.5 * math.hypot(v.width, v.length), 2))
    p.radius, p.turn = (math.hypot(x, y) if shape.kind == "box" else x) + 0.5 * v.width + v.behind, v.turn
    b.require_way(v.object)
    request = PushRequest(inflation, (x, y), shape.kind == "box", v.width, v.length, v.turn, v.slant)
    b.resources.get(PushValues).request(p, request)
    return p


def _contact_force(keys: dict[str, Any], b: Binding) -> costs.ContactForceParams:
    v = parse_keys(ContactForce, keys, b)
    p = costs.ContactForceParams()
    p.first, p.count = b.watch(*v.between, "between")
    return p


def _controls(keys: dict[str, Any], b: Binding) -> costs.ControlParams:
    p = costs.ControlParams()
    p.first, p.count = robot_range(parse_keys(Robots, keys, b), list(b.layout.control_name), b)
    return p


def _joint_velocity(keys: dict[str, Any], b: Binding) -> costs.JointVelocityParams:
    p = costs.JointVelocityParams()
    p.joint = b.array(joint_dofs(parse_keys(Joints, keys, b), b), dtype=int)
    return p


def _posture(keys: dict[str, Any], b: Binding) -> costs.PostureParams:
    coords = b.layout.dof_coord[joint_dofs(parse_keys(Joints, keys, b), b)]
    coords = coords[coords >= 0]
    p = costs.PostureParams()
    p.coord = b.array(coords, dtype=int)
    p.target = b.array(b.layout.joint_q[coords], dtype=float)
    return p


def _joint_limit(keys: dict[str, Any], b: Binding) -> costs.JointLimitParams:
    v = parse_keys(JointLimit, keys, b)
    layout = b.layout
    span = np.abs(layout.dof_upper - layout.dof_lower)
    if v.joints is not None:
        dofs = named_dofs(v, b)
        if free := [layout.dof_name[i] for i in dofs if span[i] >= 1e6]:
            raise SceneError("this joint has no limits", key=f"{b.key}.joints", file=b.file, found=free[0])
    else:
        first, count = robot_range(Robots(of=v.of), dof_names(b), b)
        dofs = [i for i in range(first, first + count) if layout.dof_coord[i] >= 0 and span[i] < 1e6]
    p = costs.JointLimitParams()
    p.coord = b.array(layout.dof_coord[dofs], dtype=int)
    p.lower = b.array(layout.dof_lower[dofs] + v.margin, dtype=float)
    p.upper = b.array(layout.dof_upper[dofs] - v.margin, dtype=float)
    return p


def _obstacle_clearance(keys: dict[str, Any], b: Binding) -> clearance.ObstacleClearanceParams:
    v = parse_keys(ObstacleClearance, keys, b)
    b.require_still()
    if v.to not in ("surface", "centre"):
        raise SceneError("wrong value", key=f"{b.key}.to", file=b.file, found=v.to, allowed=["surface", "centre"])
    shapes = [b.layout.shapes[i] for e in b.layout.group("obstacles") for i in e.shapes]
    if meshes := [s.name for s in shapes if s.kind not in PRIMITIVES]:
        raise SceneError("clearance needs primitive obstacles", key=b.key, file=b.file, found=meshes[0])
    p = clearance.ObstacleClearanceParams()
    p.of, p.radius, p.least, p.surface = b.frame(v.of, "of"), v.radius, v.least, int(v.to == "surface")
    inverse = [wp.transform_inverse(wp.transform(*s.pose)) for s in shapes]
    p.pose = b.array(np.array(inverse, dtype=np.float32).reshape(-1, 7), dtype=wp.transform)
    p.kind = b.array([PRIMITIVES[s.kind] for s in shapes], dtype=int)
    p.size = b.array(np.array([s.scale for s in shapes], dtype=np.float32).reshape(-1, 3), dtype=wp.vec3)
    return p


def _outline_clearance(keys: dict[str, Any], b: Binding) -> clearance.OutlineClearanceParams:
    v = parse_keys(OutlineClearance, keys, b)
    b.require_still()
    p = clearance.OutlineClearanceParams()
    p.of, p.within = b.frame(v.of, "of"), v.within
    layout = b.layout
    body = int(layout.frame_body[p.of])
    own = [s for s in layout.shapes if s.body == body and s.collides and s.kind != "plane"]
    if body < 0 or not own:
        raise SceneError("this frame's body has no colliding shape", key=f"{b.key}.of", file=b.file, found=v.of)
    to_frame = wp.transform_inverse(wp.transform(*layout.frame_pose[p.of]))
    lying = {e.name for e in layout.group("objects")}
    supports = b.supports if v.of.split("/")[0] in lying else ()
    outlines = [convex_outline(np.concatenate([outline(layout, s, to_frame) for s in own]))]
    outlines += [corners for _, corners in obstacle_outlines(layout, supports)]
    counts = [len(o) for o in outlines]
    centres = [o.mean(axis=0) for o in outlines]
    p.corner = b.array(np.concatenate(outlines).astype(np.float32), dtype=wp.vec2)
    p.first = b.array(np.cumsum([0, *counts[:-1]]), dtype=int)
    p.count = b.array(counts, dtype=int)
    p.centre = b.array(np.array(centres, dtype=np.float32), dtype=wp.vec2)
    radii = [np.linalg.norm(o - c, axis=1).max() for o, c in zip(outlines, centres, strict=True)]
    p.radius = b.array(radii, dtype=float)
    return p


def _outline_distance(keys: dict[str, Any], b: Binding) -> clearance.OutlineDistanceParams:
    v = parse_keys(OutlineDistance, keys, b)
    shape = b.object_shape(v.object, "object")
    p = clearance.OutlineDistanceParams()
    p.of, p.object, p.inside = b.frame(v.of, "of"), b.frame(v.object, "object"), v.inside
    p.pose = wp.transform_inverse(wp.transform(*shape.pose))
    x, y, _ = shape.scale
    # as tall as needed: the nearest point of the shape then lies level with the frame
    p.kind, p.size = (PRIMITIVES["box"], wp.vec3(x, y, 1e3)) if shape.kind == "box" else (2, wp.vec3(x, 1e3, 0.0))
    return p


def _height(keys: dict[str, Any], b: Binding) -> costs.HeightParams:
    v = parse_keys(Height, keys, b)
    p = costs.HeightParams()
    p.of, p.target, p.slack = b.frame(v.of, "of"), v.target, v.slack
    return p


def _orientation(keys: dict[str, Any], b: Binding) -> costs.OrientationParams:
    v = parse_keys(Orientation, keys, b)
    p = costs.OrientationParams()
    p.of, p.to, p.tilt = b.frame(v.of, "of"), b.frame(v.to, "to"), int(v.tilt)
    return p


def _approach(keys: dict[str, Any], b: Binding) -> grasping.ApproachParams:
    v = parse_keys(Approach, keys, b)
    p = grasping.ApproachParams()
    p.hand, p.object, p.width, p.rise = b.frame(v.hand, "hand"), b.frame(v.object, "object"), v.width, v.rise
    return p


def _finger_alignment(keys: dict[str, Any], b: Binding) -> grasping.FingerAlignmentParams:
    v = parse_keys(FingerAlignment, keys, b)
    if (kind := b.object_shape(v.object, "object").kind) != "box":
        raise SceneError("fingers meet the faces of a box", key=f"{b.key}.object", file=b.file, found=kind)
    p = grasping.FingerAlignmentParams()
    p.hand, p.object = b.frame(v.hand, "hand"), b.frame(v.object, "object")
    return p


def _gripper(keys: dict[str, Any], b: Binding) -> grasping.GripperParams:
    v = parse_keys(Gripper, keys, b)
    p = grasping.GripperParams()
    p.hand, p.object, p.near = b.frame(v.hand, "hand"), b.frame(v.object, "object"), v.near
    controls = [b.control(name, "fingers") for name in v.fingers]
    p.finger = b.array(controls, dtype=int)
    p.middle = b.array(0.5 * (b.layout.control_lower + b.layout.control_upper)[controls], dtype=float)
    return p


BUILTIN = {
    term.name: term
    for term in (
        CostTerm(
            "distance",
            costs.distance,
            costs.DistanceParams,
            _distance,
            Distance,
            residual=components.DISTANCE,
        ),
        CostTerm("yaw", costs.yaw_error, costs.YawParams, _yaw, Yaw, residual=components.YAW),
        CostTerm(
            "push_alignment",
            pushing.push_alignment,
            pushing.PushAlignmentParams,
            _push_alignment,
            PushAlignment,
        ),
        CostTerm(
            "push_path", pushing.push_path, pushing.PushPathParams, _push_path, PushPath, native_pushing.push_path
        ),
        CostTerm(
            "contact_force",
            costs.contact_cost,
            costs.ContactForceParams,
            _contact_force,
            ContactForce,
        ),
        CostTerm(
            "control_effort",
            costs.control_effort,
            costs.ControlParams,
            _controls,
            Robots,
            residual=components.CONTROL_EFFORT,
        ),
        CostTerm(
            "control_rate",
            costs.control_rate,
            costs.ControlParams,
            _controls,
            Robots,
            residual=components.CONTROL_RATE,
        ),
        CostTerm(
            "joint_limit",
            costs.joint_limit,
            costs.JointLimitParams,
            _joint_limit,
            JointLimit,
            residual=components.JOINT_LIMIT,
        ),
        CostTerm(
            "joint_velocity",
            costs.joint_velocity_cost,
            costs.JointVelocityParams,
            _joint_velocity,
            Joints,
            residual=components.JOINT_VELOCITY,
        ),
        CostTerm("posture", costs.posture, costs.PostureParams, _posture, Joints, residual=components.POSTURE),
        CostTerm(
            "obstacle_clearance",
            clearance.obstacle_clearance,
            clearance.ObstacleClearanceParams,
            _obstacle_clearance,
            ObstacleClearance,
        ),
        CostTerm(
            "outline_clearance",
            clearance.outline_clearance,
            clearance.OutlineClearanceParams,
            _outline_clearance,
            OutlineClearance,
            native_clearance.outline_clearance,
        ),
        CostTerm(
            "outline_distance",
            clearance.outline_distance,
            clearance.OutlineDistanceParams,
            _outline_distance,
            OutlineDistance,
        ),
        CostTerm("approach", grasping.approach, grasping.ApproachParams, _approach, Approach),
        CostTerm(
            "finger_alignment",
            grasping.finger_alignment,
            grasping.FingerAlignmentParams,
            _finger_alignment,
            FingerAlignment,
        ),
        CostTerm("gripper", grasping.gripper, grasping.GripperParams, _gripper, Gripper),
        CostTerm("height", costs.height, costs.HeightParams, _height, Height, residual=components.HEIGHT),
        CostTerm(
            "orientation",
            costs.orientation,
            costs.OrientationParams,
            _orientation,
            Orientation,
            residual=components.ORIENTATION,
        ),
        *arm.TERMS,
        *collision.TERMS,
        *rolling.TERMS,
        *cloud.TERMS,
        *learned.TERMS,
        *residuals.TERMS,
        *numbers.TERMS,
        *gait.TERMS,
    )
}
"""Built-in terms by name."""
