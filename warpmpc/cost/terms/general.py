# SPDX-License-Identifier: Apache-2.0
"""Terms of frames, controls and contacts."""

import math
from enum import StrEnum
from typing import Any

import warp as wp
from pydantic import field_validator

from ...kernels.cost.norms import L22
from ...kernels.cost.view import (
    StepView,
    contact_force,
    control,
    frame_position,
    frame_rotation,
    frame_velocity,
    rotation_angle,
    wrap_angle,
    yaw,
)
from ...kernels.geometry.fields import PathFields, plane_distance
from ...scene.task.goal import GOAL
from ...scene.types import Finite, NonNegative, Vec3
from ..binding import Binding
from ..keys import Frame, TermKeys, term
from ..residual import ROUNDED, entry_of, fixed_norm, residual, rounded_length
from ..resources.guide import Guides
from ..term import Residual

UP = (0.0, 0.0, 1.0)


class Metric(StrEnum):
    """Measures of distances in the ground plane."""

    STRAIGHT = "straight"
    GEODESIC = "geodesic"


def field_of(metric: Metric, p: Any, target: int, mover: str, inflation: float | None, b: Binding) -> int:
    """Distance field to a frame, -1 for the straight metric.

    Args:
        metric: The metric.
        p: Parameters of the term, whose ``paths`` will point at the fields.
        target: The frame.
        mover: What goes there, by whose shapes obstacles grow.
        inflation: By how much they grow in place of that [m].
        b: The term being bound.

    Raises:
        SceneError: If obstacles move with the task.
    """
    if metric is Metric.STRAIGHT:
        return -1
    b.require_still("metric")
    return b.resources.get(Guides).request(p, target, b.footprint(mover) if inflation is None else inflation)


class Distance(TermKeys):
    """Distance between two frames [m]."""

    between: tuple[str, str]
    """Two frames: [from, to]."""
    metric: Metric = Metric.STRAIGHT
    """straight, or geodesic: along the shortest path around the obstacles to the second frame."""
    planar: bool = False
    """Leave the height out; always so with the geodesic metric and for goals without a height."""
    inflation: NonNegative | None = None
    """Geodesic: obstacles grow by this for the mover's size [m]; from its shapes when left out."""
    near: NonNegative = 0.0
    """Saturate: 1 - exp(-d/near), a pull that acts within about this distance alone [m]; 0 means d itself."""
    lead: NonNegative = 0.0
    """Measure from where the first frame's body would coast to in this time [s]: for what rolls on by itself."""

    derived = {"first": int, "second": int, "planar": int, "field": int, "paths": PathFields}

    def bind(self, p: Any, b: Binding) -> None:
        """Find frames and distance field."""
        p.first, p.second = (b.frame(name, "between") for name in self.between)
        flat = bool(b.scene.flat_poses & {*self.between})
        p.planar = int(self.planar or flat or self.metric is Metric.GEODESIC)
        p.field = field_of(self.metric, p, p.second, self.between[0], self.inflation, b)


@wp.func
def reached(s: StepView, p: Distance.Params) -> wp.vec3:
    """Place of the first frame, or where it would coast to [m]."""
    a = frame_position(s, p.first)
    if p.lead != 0.0:
        a += p.lead * frame_velocity(s, p.first)
    return a


@wp.func
def way(s: StepView, p: Distance.Params) -> wp.vec3:
    """Difference of the two positions [m]."""
    return reached(s, p) - frame_position(s, p.second)


def _straight(p: Any) -> int:
    """Count the axes of a distance that is a straight line and does not saturate; others are no norm."""
    return (2 if p.planar else 3) if p.near == 0.0 and (not p.planar or p.field < 0) else 0


@term("distance", Distance, residual=Residual(entry_of(way, Distance.Params), _straight, rounded_length))
def distance(s: StepView, p: Distance.Params) -> float:
    """Distance between two frames, ‖p_a - p_b‖ (Pezzato et al. 2025, Eq. 10), straight or along the geodesic [m].

    With ``near`` it saturates, 1 - exp(-d/near): a pull that acts close to the target alone. With ``lead`` it is
    measured from p_a + lead · ṗ_a, so that what rolls or slides on after the horizon is seen to do so.
    """
    d = wp.length(way(s, p))
    if p.planar != 0:
        a = reached(s, p)
        b = frame_position(s, p.second)
        d = plane_distance(s, p.paths, p.field, wp.vec2(b[0], b[1]), wp.vec2(a[0], a[1]))
    if p.near > 0.0:
        return 1.0 - wp.exp(-d / p.near)
    return d


class Yaw(TermKeys):
    """Heading error of a frame [rad]."""

    of: Frame
    """Frame."""
    to: Frame = "goal"
    """Frame it is compared with."""
    near: NonNegative = 0.0
    """Fade: full weight at the target, 1/e of it at this distance [m]; 0 means the same weight everywhere."""
    smooth: NonNegative = 0.0
    """√(ψ² + p²) - p instead of |ψ| [rad]: errors below about p cost little, a push may turn the object a bit."""


@wp.func
def heading_error(s: StepView, p: Yaw.Params, i: int) -> float:
    """Heading error with its sign [rad]."""
    return wrap_angle(yaw(frame_rotation(s, p.of)) - yaw(frame_rotation(s, p.to)))


@term(
    "yaw",
    Yaw,
    residual=Residual(
        heading_error, lambda p: int(p.near == 0.0), norm=lambda p: fixed_norm(L22, max(p.smooth, ROUNDED))
    ),
)
def yaw_error(s: StepView, p: Yaw.Params) -> float:
    """Heading error |ψ_a - ψ_b| on the circle (Eq. 10), optionally fading with the distance to the target.

    With ``smooth`` the error counts by MuJoCo MPC's SmoothAbs norm (Howell et al. 2022): small errors cost little.
    """
    error = wp.abs(heading_error(s, p, 0))
    error = wp.sqrt(error * error + p.smooth * p.smooth) - p.smooth
    if p.near > 0.0:
        d = frame_position(s, p.of) - frame_position(s, p.to)
        error *= wp.exp(-wp.length(wp.vec2(d[0], d[1])) / p.near)
    return error


class Height(TermKeys):
    """Height error of a frame [m]."""

    of: Frame
    """Frame."""
    target: Finite
    """Wanted height [m]."""
    slack: NonNegative = 0.0
    """Errors up to this cost nothing [m]."""


@wp.func
def height_error(s: StepView, p: Height.Params, i: int) -> float:
    """Height of a frame above or below the one that it shall have, less the slack [m]."""
    error = frame_position(s, p.of)[2] - p.target
    return wp.sign(error) * wp.max(wp.abs(error) - p.slack, 0.0)


@term("height", Height, residual=Residual(height_error, lambda p: 1, rounded_length))
def height(s: StepView, p: Height.Params) -> float:
    """Height error of a frame, max(0, |z - target| - slack) (Pezzato et al. 2025, C_ee) [m]."""
    return wp.abs(height_error(s, p, 0))


class Orientation(TermKeys):
    """Angle between the orientations of two frames [rad]."""

    of: Frame
    """Frame."""
    to: str | None = None
    """Frame it is compared with. When left out, the goal; with `axis`, or without a goal, the world."""
    tilt: bool = False
    """Compare the directions of the z axes alone."""
    axis: Vec3 | None = None
    """Compare the direction of this axis alone, in the axes of `of`."""
    along: Vec3 = UP
    """Direction that it shall have, in the axes of `to`; up when left out."""

    derived = {"to": int, "axis": wp.vec3, "along": wp.vec3}

    @field_validator("axis", "along")
    @classmethod
    def _directed(cls, value: Vec3 | None) -> Vec3 | None:
        if value is not None and math.hypot(*value) < 1e-6:
            raise ValueError("a direction (x, y, z) of length above zero")
        return value

    def bind(self, p: Any, b: Binding) -> None:
        """Find the frame to compare with.

        Raises:
            SceneError: If the name does not exist, or there is a direction without an axis.
        """
        world = self.to is None and (self.axis is not None or GOAL not in b.layout.frame_name)
        p.to = -1 if world else b.frame(self.to or GOAL, "to")
        if self.along != UP and self.axis is None:
            raise b.error("is the direction of an axis, which is missing: axis = [0, 0, 1] is its own z", "along")
        p.tilt = int(self.tilt or self.axis is not None)
        p.axis, p.along = (wp.normalize(wp.vec3(*v)) for v in (self.axis or UP, self.along))


@wp.func
def wanted_rotation(s: StepView, p: Orientation.Params) -> wp.quat:
    """Rotation of what a frame is compared with."""
    if p.to < 0:
        return wp.quat(0.0, 0.0, 0.0, 1.0)
    return frame_rotation(s, p.to)


@wp.func
def rotation_vector(s: StepView, p: Orientation.Params) -> wp.vec3:
    """Rotation vector between two frames, or between directions of theirs [rad]."""
    a = frame_rotation(s, p.of)
    b = wanted_rotation(s, p)
    if p.tilt != 0:
        za = wp.quat_rotate(a, p.axis)
        zb = wp.quat_rotate(b, p.along)
        axis = wp.cross(za, zb)
        size = wp.length(axis)
        return axis * wp.where(size > 1.0e-6, wp.atan2(size, wp.dot(za, zb)) / wp.max(size, 1.0e-6), 1.0)
    q = wp.quat_inverse(b) * a
    if q[3] < 0.0:
        q = -q
    v = wp.vec3(q[0], q[1], q[2])
    size = wp.length(v)
    return v * wp.where(size > 1.0e-6, 2.0 * wp.atan2(size, q[3]) / wp.max(size, 1.0e-6), 2.0)


@term(
    "orientation",
    Orientation,
    residual=Residual(entry_of(rotation_vector, Orientation.Params), lambda p: 3, rounded_length),
)
def orientation(s: StepView, p: Orientation.Params) -> float:
    """Angle between the orientations of two frames, or between directions of theirs [rad].

    `axis = [0, 0, 1]` alone holds a frame upright.
    """
    a = frame_rotation(s, p.of)
    b = wanted_rotation(s, p)
    if p.tilt == 0:
        return rotation_angle(a, b)
    za = wp.quat_rotate(a, p.axis)
    zb = wp.quat_rotate(b, p.along)
    return wp.atan2(wp.length(wp.cross(za, zb)), wp.dot(za, zb))


class ContactForce(TermKeys):
    """Sum of net contact forces [N]."""

    between: tuple[str, str]
    """Two entities or groups (obstacles, objects, robots)."""

    derived = {"first": int, "count": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Watch the pairs."""
        p.first, p.count = b.watch(*self.between, "between")


@term("contact_force", ContactForce)
def contact_cost(s: StepView, p: ContactForce.Params) -> float:
    """Contact forces, Σ ‖F‖ over pairs of bodies (Eq. 7) [N]."""
    total = wp.float32(0.0)
    for i in range(p.count):
        total += wp.length(contact_force(s, p.first + i))
    return total


class Controls(TermKeys):
    """Controls of one robot, or of all."""

    of: str | None = None
    """Robot; all when left out."""

    derived = {"first": int, "numbers": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the range of controls."""
        own = b.owned(self.of, b.layout.control_name)
        p.first, p.numbers = own.start, len(own)


@residual("control_effort", Controls)
def control_effort(s: StepView, p: Controls.Params, i: int) -> float:
    """Squared controls, Σ (u_i / half range)²."""
    u = p.first + i
    return control(s, u) / s.control_scale[u]


@residual("control_rate", Controls)
def control_rate(s: StepView, p: Controls.Params, i: int) -> float:
    """Squared changes of the controls, Σ ((u_i - previous u_i) / half range)², from the control that acts now."""
    u = p.first + i
    before = s.last_control[s.e, u]
    if s.t > 1:
        before = s.controls[s.t - 2, s.w, u]
    return (control(s, u) - before) / s.control_scale[u]
