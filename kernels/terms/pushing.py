# SPDX-License-Identifier: Apache-2.0
"""Cost terms for pushing an object to its goal: alignment, and the work that is left."""

import warp as wp

from ..geometry.fields import sample_push
from .paths import PathFields, plane_distance, way_out
from .view import (
    StepView,
    frame_pose,
    frame_position,
    frame_velocity,
    wrap_angle,
    yaw,
)

wp.set_module_options({"enable_backward": False})

EPSILON = wp.constant(1.0e-6)

WHOLE_TURN = wp.constant(0.3)  # [rad] a heading error from which on the place to turn an object from counts in full
WHOLE_SIDE = wp.constant(0.52)  # [rad] an object turned by less than this from straight is pushed at its side's middle
BESIDE_CORNER = wp.constant(0.12)  # [rad] from an object's corner: a push there turns it towards the side pushed at
SWIVEL_PLAY = wp.constant(3.0)  # [1/rad] how much wider the tolerance is of an object that must still be turned
SWIVEL_RANGE = wp.constant(0.2)  # [m] from the goal's tolerance, within which an object is turned rather than moved
COAST_RANGE = wp.constant(0.2)  # [m] an object that coasts past its goal at this distance misses it
SWIVEL_PRICE = wp.constant(0.4)  # of a way around the object; more would keep turned objects away from the goal


@wp.struct
class PushAlignmentParams:
    """Parameters of ``push_alignment``."""

    pusher: int
    object: int
    goal: int
    field: int
    paths: PathFields
    near: float  # [m] the term fades as the object comes closer to the goal than about this
    slack: float  # subtracted, so that the pusher may choose its place on a side of the object


@wp.func
def push_alignment(s: StepView, p: PushAlignmentParams) -> float:
    """Cos α + 1 with α between object → pusher and object → goal (Eq. 10): zero when pushing straight at the goal.

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


@wp.struct
class PushPathParams:
    """Parameters of ``push_path``."""

    pusher: int
    object: int
    goal: int
    tolerance: float  # [m] along each axis of the goal
    value: wp.array4d[float]  # [E, rows, columns, 16] work left, in the goal's frame [m]
    origin: wp.array[wp.vec2]  # [E] place of the first cell in the goal's frame [m]
    cell: float  # [m]
    field: int  # distance field of the pusher to the object
    paths: PathFields
    radius: float  # [m] of a circle around the object, outside of which the pusher goes straight
    turn: float  # cost of a metre that the pusher goes, relative to a metre of pushing
    faces: int  # whether the object has sides
    broad: float  # [rad] direction of a broad side in the object's frame
    arm: float  # [rad] beside the middle of a broad side: a place to turn the object from
    aim: wp.vec2  # [rad] at most this far beside the middle of a narrow and of a broad side on the way
    steer: float  # how far to push beside the middle, as an angle per heading error
    lead: float  # [s] look at where the object would coast to in this time
    through: int  # whether a way through the goal counts to there alone


@wp.func
def shrink(d: float, tolerance: float) -> float:
    """Zero within ± tolerance, d itself beyond 2.5 times that, and continuous."""
    a = wp.abs(d)
    if a < 2.5 * tolerance:
        a = wp.max(a - tolerance, 0.0) * 2.5 / 1.5
    return wp.sign(d) * a


@wp.func
def side_place(error: float, steer: float, largest: float) -> float:
    """Place to push an object turned by ``error`` so that it goes straight and turns back, from straight behind [rad].

    Within ``WHOLE_SIDE`` that is beside the middle of its side, by 1 + ``steer`` times the error, at most
    ``largest``. Turned by 45° it is on the same side, just beside the corner that then faces straight; on the other
    side of that corner a push would turn the object on. Only beyond 60° the next side takes over, and without a
    jump: pushers wait where the cost jumps. The corners are those of a square: of a longer object's narrow sides
    they are nearer, so for these it is a rule of thumb. At 180° both ways back are equally long, and there it does
    jump.
    """
    a = wp.abs(error)
    turned = a - wp.half_pi * wp.floor((a + wp.pi / 12.0) / wp.half_pi)  # from the side in use, -15° to 75°
    aim = wp.min((1.0 + steer) * a, largest)
    corner = wp.pi / 4.0
    last = wp.pi / 3.0
    place = turned - aim
    if turned > last:
        place = wp.lerp(last - corner + BESIDE_CORNER, -wp.pi / 12.0 - aim, (turned - last) / (wp.pi / 12.0))
    elif turned > corner:
        place = turned - corner + BESIDE_CORNER
    elif turned > WHOLE_SIDE:
        place = wp.lerp(WHOLE_SIDE - aim, BESIDE_CORNER, (turned - WHOLE_SIDE) / (corner - WHOLE_SIDE))
    return wp.sign(error) * place


@wp.func
def swivel(angle: float, error: float, aside: float, arm: float) -> float:
    """Distance of the pusher from where it would turn an object back by its heading error [rad].

    That is ``arm`` beside the middle of a broad side, ``angle`` away from the first one; small errors count less.
    There are two such places. ``aside`` says how far the object lies towards the first, in tolerances: the farther
    it lies to one side, up to half a tolerance, the more that side counts alone. A push from there brings it back
    rather than away.
    """
    off = angle + wp.sign(error) * arm
    nearest = wp.abs(off - wp.pi * wp.round(off / wp.pi))
    outer = wp.abs(wrap_angle(off + wp.where(aside < 0.0, wp.pi, 0.0)))
    share = wp.min(2.0 * wp.abs(aside), 1.0)
    return wp.lerp(nearest, outer, share) * wp.min(wp.abs(error) / WHOLE_TURN, 1.0)


@wp.func
def coasting_time(off: wp.vec2, velocity: wp.vec2, lead: float, tolerance: float) -> float:
    """Time that an object ``off`` its goal coasts: ``lead``, or until it is nearest to a goal it does not miss.

    All of ``lead`` counts when it passes the tolerance at ``COAST_RANGE`` or more, and less the nearer it passes. If it
    always did, an object would have to come slowly enough not to coast past the goal in that time.
    """
    nearest = wp.clamp(-wp.dot(off, velocity) / wp.max(wp.dot(velocity, velocity), EPSILON), 0.0, lead)
    miss = off + nearest * velocity
    outside = wp.vec2(wp.max(wp.abs(miss[0]) - tolerance, 0.0), wp.max(wp.abs(miss[1]) - tolerance, 0.0))
    return wp.lerp(nearest, lead, wp.min(wp.length(outside) / COAST_RANGE, 1.0))


@wp.func
def push_path(s: StepView, p: PushPathParams) -> float:
    """Work left to push an object to the goal around the obstacles, the pusher's own way included [m].

    min over sides d of V(o, d) + turn · walk(r → d), with V from dynamic programming (``warpmpc.cost.push_path``). The
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
    turning = float(0.0)
    beside = float(0.0)
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
