# SPDX-License-Identifier: Apache-2.0
"""Terms for pushing an object to its goal: alignment, and the work that is left."""

import math
from typing import Annotated, Any

import warp as wp
from pydantic import Field

from ...kernels.cost.pushing import (
    EPSILON,
    SWIVEL_PLAY,
    SWIVEL_PRICE,
    SWIVEL_RANGE,
    coasting_time,
    shrink,
    side_place,
    swivel,
)
from ...kernels.cost.view import StepView, frame_pose, frame_position, frame_velocity, wrap_angle, yaw
from ...kernels.geometry.fields import PathFields, plane_distance, sample_push, way_out
from ...scene.types import NonNegative, Positive
from ..binding import Binding
from ..keys import Frame, Object, TermKeys, term
from ..resources.guide import Guides
from ..resources.push_value import PushRequest, PushValues
from .general import Metric, field_of

_LEAST_ARM = 0.4
"""A place to turn a box from is at least this far beside the middle of a broad side [rad], for broad pushers."""


class PushAlignment(TermKeys):
    """cos α + 1: zero when the object lies between pusher and goal."""

    pusher: Frame
    """Frame that pushes."""
    object: Frame
    """Object that is pushed."""
    goal: Frame = "goal"
    """Frame it is pushed to."""
    metric: Metric = Metric.STRAIGHT
    """straight, or geodesic: the direction in which the path to the goal leaves the object."""
    inflation: NonNegative | None = None
    """Geodesic: obstacles grow by this for the object's size [m]."""
    near: NonNegative = 0.0
    """Fade: the term vanishes as the object comes closer to the goal than about this [m]."""
    slack: NonNegative = 0.0
    """max(cos α + 1 - slack, 0) instead: leaves the pusher a choice of places; 0.3 is about ± 45°."""

    derived = {"field": int, "paths": PathFields}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the distance field to the goal."""
        p.field = field_of(self.metric, p, p.goal, self.object, self.inflation, b)


@term("push_alignment", PushAlignment)
def push_alignment(s: StepView, p: PushAlignment.Params) -> float:
    """Alignment of a push, cos α + 1 with α between object → pusher and object → goal (Eq. 10); zero if straight.

    With a distance field the direction to the goal is the field's downhill direction at the object. With ``slack`` the
    term is max(cos α + 1 - slack, 0), zero over a range of directions.
    """
    r = frame_position(s, p.pusher)
    o = frame_position(s, p.object)
    g = frame_position(s, p.goal)
    to_pusher = wp.vec2(r[0] - o[0], r[1] - o[1])
    straight = wp.vec2(g[0] - o[0], g[1] - o[1])
    to_goal = way_out(s, p.paths, p.field, wp.vec2(o[0], o[1]), straight)
    scale = wp.length(to_pusher) * wp.length(to_goal)
    value = wp.max(wp.dot(to_pusher, to_goal) / wp.max(scale, EPSILON) + 1.0 - p.slack, 0.0)
    if p.near > 0.0:
        value *= 1.0 - wp.exp(-wp.length(straight) / p.near)
    return value


class PushPath(TermKeys):
    """Work left to push an object to the goal around the obstacles [m]: pushes, and ways around the object."""

    pusher: Frame
    """Frame that pushes."""
    object: Object
    """Object that is pushed, upright."""
    inflation: NonNegative | None = None
    """Obstacles grow by this for the object's size [m]; from its shapes when left out."""
    width: Positive
    """Room that the pusher needs across its direction of pushing [m]."""
    length: NonNegative
    """Room that the pusher needs behind its frame [m]."""
    behind: NonNegative = 0.0
    """How far the frame is behind the pusher's front [m]."""
    tolerance: NonNegative = 0.0
    """How far from the goal along each axis counts as there [m], for the last push; up to 4 times with ``steer``."""
    turn: Positive = 1.0
    """Cost of a metre around the object, relative to a metre of pushing."""
    steer: NonNegative = 0.0
    """Turn a box back: push beside its side's middle by this angle per heading error; at the goal, from there alone."""
    lead: NonNegative = 0.0
    """Look at where the object would coast to in this time [s]: for what rolls on by itself."""
    through: bool = False
    """With ``lead``: count an object that coasts through the goal as there, since it need not stop."""
    slant: Annotated[float, Field(ge=1.0)] = 1.5
    """How much dearer a push is at about 27° to a side's normal than square to it."""

    derived = {
        "goal": int,
        "value": wp.array4d[float],  # [E, rows, columns, 16] work left, in the goal's frame [m]
        "origin": wp.array[wp.vec2],  # [E] place of the first cell in the goal's frame [m]
        "cell": float,  # [m]
        "field": int,  # distance field of the pusher to the object
        "paths": PathFields,
        "radius": float,  # [m] of a circle around the object, outside of which the pusher goes straight
        "faces": int,  # 1 if the object has sides
        "broad": float,  # [rad] direction of a broad side in the object's frame
        "arm": float,  # [rad] beside the middle of a broad side: a place to turn the object from
        "aim": wp.vec2,  # [rad] at most this far beside the middle of a narrow and of a broad side on the way
        "through": int,
    }

    def bind(self, p: Any, b: Binding) -> None:
        """Find the object's shape, the distance field to it and the work that is left."""
        b.require_still()
        shape = b.object_shape(self.object, "object")
        box, p.goal = shape.kind == "box", b.frame("goal", "goal")
        x, y = shape.scale[0], shape.scale[1 if box else 0]
        p.faces, p.through, p.broad = int(box), int(self.through and self.lead > 0.0), 0.0 if y >= x else 0.5 * math.pi
        # so far out that the pusher's side reaches three quarters of the way to the corner
        p.arm = max(_LEAST_ARM, math.atan2(0.75 * max(x, y) - 0.5 * self.width, min(x, y)))
        p.aim = wp.vec2(0.75 * min(p.arm, math.atan2(min(x, y), max(x, y))), 0.75 * p.arm)
        # to a centimetre, so that a distance term can share the field
        p.field = b.resources.get(Guides).request(p, p.object, round(0.5 * math.hypot(self.width, self.length), 2))
        p.radius = (math.hypot(x, y) if box else x) + 0.5 * self.width + self.behind
        b.require_way(self.object)
        inflation = b.footprint(self.object) if self.inflation is None else self.inflation
        request = PushRequest(inflation, (x, y), box, self.width, self.length, self.turn, self.slant)
        b.resources.get(PushValues).request(p, request)


@term("push_path", PushPath)
def push_path(s: StepView, p: PushPath.Params) -> float:
    """Cost to go of pushing an object to the goal around the obstacles, with the path of the pusher [m].

    min over sides d of V(o, d) + turn · walk(r → d), with V from dynamic programming
    (``warpmpc.cost.resources.push_path``). The
    walk is straight to the sides of a circle about the object that the pusher sees, longer by what obstacles in
    between add. Being a cost-to-go, it rewards the first step to another side of the object already; so it stands for
    the object's distance to the goal and for ``push_alignment`` together.
    """
    r = frame_position(s, p.pusher)
    o = frame_position(s, p.object)
    goal = frame_pose(s, p.goal)
    g = wp.transform_get_translation(goal)
    heading = yaw(wp.transform_get_rotation(goal))
    c = wp.cos(heading)
    d = wp.sin(heading)
    to_goal = wp.mat22(c, d, -d, c)  # world → the goal's frame
    if p.lead > 0.0:
        v = frame_velocity(s, p.object)
        time = p.lead
        if p.through != 0:
            away = to_goal * wp.vec2(o[0] - g[0], o[1] - g[1])
            time = coasting_time(away, to_goal * wp.vec2(v[0], v[1]), p.lead, p.tolerance)
        o += time * v
    off = to_goal * wp.vec2(o[0] - g[0], o[1] - g[1])
    to_pusher = to_goal * wp.vec2(r[0] - o[0], r[1] - o[1])
    angle = wp.atan2(to_pusher[1], to_pusher[0])
    apart = wp.length(to_pusher)
    tolerance = p.tolerance
    turning = wp.float32(0.0)
    beside = wp.float32(0.0)
    if p.faces != 0:
        # sides are where the object's heading puts them; a pusher that stands farther anticlockwise about the object
        # than the middle of its side turns it anticlockwise
        error = wrap_angle(yaw(wp.transform_get_rotation(frame_pose(s, p.object))) - heading)
        if p.steer > 0.0:
            tolerance *= 1.0 + SWIVEL_PLAY * wp.min(wp.abs(error), 1.0)
            side = error + p.broad
            aside = wp.dot(off, wp.vec2(wp.cos(side), wp.sin(side))) / wp.max(p.tolerance, EPSILON)
            turning = SWIVEL_PRICE * p.turn * wp.min(apart, p.radius) * swivel(angle - side, error, aside, p.arm)
        across = wp.cos(angle - error - p.broad)  # ± 1 at the middle of a broad side, 0 of a narrow one
        beside = -side_place(error, p.steer, wp.lerp(p.aim[0], p.aim[1], across * across))
    at = wp.vec2(shrink(off[0], tolerance), shrink(off[1], tolerance))
    turning *= wp.max(1.0 - wp.length(at) / SWIVEL_RANGE, 0.0)
    angle += beside
    origin = p.origin[s.e]
    best = sample_push(p.value, s.e, origin, p.cell, at, angle)
    if apart <= p.radius:
        return best + turning
    best += p.turn * (apart - p.radius)
    seen = wp.acos(p.radius / apart)
    for i in range(1, 4):
        part = seen * float(i) / 3.0
        half = wp.sin(0.5 * part)
        # the law of cosines, without the difference of nearly equal squares
        way = p.turn * wp.sqrt((apart - p.radius) * (apart - p.radius) + 4.0 * apart * p.radius * half * half)
        left = sample_push(p.value, s.e, origin, p.cell, at, angle + part)
        right = sample_push(p.value, s.e, origin, p.cell, at, angle - part)
        best = wp.min(best, wp.min(left, right) + way)
    way = plane_distance(s, p.paths, p.field, wp.vec2(o[0], o[1]), wp.vec2(r[0], r[1]))
    return best + turning + p.turn * (way - apart)
