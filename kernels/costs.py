# SPDX-License-Identifier: Apache-2.0
"""Cost terms: one Warp function each, over one step of one world.

Every term has the signature ``(s: StepView, p: Params) -> float``. ``s`` is one step of one rollout, read with the
functions at the top of this file; ``p`` holds the term's parameters. Weights are applied by the kernel that calls
the term (see ``warpmpc.cost.term``).
"""

import warp as wp

from .fields import field_gradient, sample_field, sample_push

wp.set_module_options({"enable_backward": False})

GOAL_BODY = wp.constant(-2)
EPSILON = wp.constant(1.0e-6)

SPHERE = wp.constant(0)
BOX = wp.constant(1)
CYLINDER = wp.constant(2)
CAPSULE = wp.constant(3)
PLANE = wp.constant(4)

LARGEST_STEER = wp.constant(0.3)  # [rad] beside the middle of an object's side, for turning it
SWIVEL = wp.constant(0.4)  # [rad] beside the middle of a broad side: a place to turn an object from
SWIVEL_PLAY = wp.constant(3.0)  # [1/rad] how much wider the tolerance is of an object that must still be turned
SWIVEL_RANGE = wp.constant(0.2)  # [m] from the goal's tolerance, within which an object is turned rather than moved
SWIVEL_PRICE = wp.constant(0.4)  # of a way around the object; more would keep turned objects away from the goal


@wp.struct
class StepView:
    """One step of one rollout: everything a cost term may look at."""

    t: int  # slice of the state arrays, 1..T: the state after t controls
    w: int  # world
    e: int  # environment
    joint_q: wp.array3d[float]  # [T+1, W, nq]
    joint_qd: wp.array3d[float]  # [T+1, W, nv]
    body_q: wp.array3d[wp.transform]  # [T+1, W, nb]
    body_qd: wp.array3d[wp.spatial_vector]  # [T+1, W, nb]
    force: wp.array3d[wp.vec3]  # [T, W, pair] [N]
    controls: wp.array3d[float]  # [T, W, nu]
    last_control: wp.array2d[float]  # [E, nu] control that acts when the plan starts
    control_scale: wp.array[float]  # [nu] half range of each control
    goal: wp.array[wp.transform]  # [E]
    frame_body: wp.array[int]  # [nf] body, -1 world, -2 goal
    frame_pose: wp.array[wp.transform]  # [nf] in the body's frame
    field: wp.array3d[float]  # [E·F, rows, columns] distance fields
    field_center: wp.array[wp.vec2]  # [E·F] point that each field measures the distance to
    field_origin: wp.vec2
    field_cell: float
    fields: int  # F per environment


@wp.func
def frame_pose(s: StepView, frame: int) -> wp.transform:
    """World pose of a frame at this step."""
    body = s.frame_body[frame]
    if body == GOAL_BODY:
        return s.goal[s.e] * s.frame_pose[frame]
    if body < 0:
        return s.frame_pose[frame]
    return s.body_q[s.t, s.w, body] * s.frame_pose[frame]


@wp.func
def frame_position(s: StepView, frame: int) -> wp.vec3:
    """World position of a frame at this step [m]."""
    return wp.transform_get_translation(frame_pose(s, frame))


@wp.func
def frame_rotation(s: StepView, frame: int) -> wp.quat:
    """World orientation of a frame at this step."""
    return wp.transform_get_rotation(frame_pose(s, frame))


@wp.func
def frame_velocity(s: StepView, frame: int) -> wp.vec3:
    """World velocity [m/s] of the centre of mass of a frame's body; zero for fixed frames."""
    body = s.frame_body[frame]
    if body < 0:
        return wp.vec3(0.0)
    return wp.spatial_top(s.body_qd[s.t, s.w, body])


@wp.func
def joint_position(s: StepView, i: int) -> float:
    """Joint coordinate i at this step [m or rad]."""
    return s.joint_q[s.t, s.w, i]


@wp.func
def joint_velocity(s: StepView, i: int) -> float:
    """Joint velocity i at this step [m/s or rad/s]."""
    return s.joint_qd[s.t, s.w, i]


@wp.func
def control(s: StepView, i: int) -> float:
    """Control i that led to this step."""
    return s.controls[s.t - 1, s.w, i]


@wp.func
def contact_force(s: StepView, pair: int) -> wp.vec3:
    """Net contact force of a watched pair during the control that led to this step [N]."""
    return s.force[s.t - 1, s.w, pair]


@wp.func
def yaw(q: wp.quat) -> float:
    """Heading of a rotation about z, in (-π, π]."""
    return wp.atan2(2.0 * (q[3] * q[2] + q[0] * q[1]), 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))


@wp.func
def wrap_angle(a: float) -> float:
    """The same angle in (-π, π]."""
    return wp.atan2(wp.sin(a), wp.cos(a))


@wp.func
def rotation_angle(a: wp.quat, b: wp.quat) -> float:
    """Angle between two orientations, in [0, π]."""
    d = wp.quat_inverse(a) * b
    return 2.0 * wp.atan2(wp.length(wp.vec3(d[0], d[1], d[2])), wp.abs(d[3]))


@wp.func
def plane_distance(s: StepView, field: int, target: wp.vec2, p: wp.vec2) -> float:
    """Distance in the ground plane, straight or along the shortest path around the obstacles.

    The field holds the path length to where the target was when the plan started. What it exceeds the straight
    line by is the detour at p; the target may move during the horizon, so the detour is added to the straight
    distance to where it is now.
    """
    straight = wp.length(p - target)
    if field < 0:
        return straight
    f = s.e * s.fields + field
    path = sample_field(s.field, f, s.field_origin, s.field_cell, p)
    # between cells the field is interpolated, which adds a little near the target
    return straight + wp.max(path - wp.length(p - s.field_center[f]) - 0.25 * s.field_cell, 0.0)


@wp.struct
class DistanceParams:
    """Parameters of ``distance``."""

    first: int
    second: int
    planar: int  # compare x and y alone
    field: int  # distance field, -1 for the straight line
    near: float  # [m] saturate: 1 - exp(-d/near) instead of d; 0 means d itself
    lead: float  # [s] measure from where the first frame would coast to in this time


@wp.func
def distance(s: StepView, p: DistanceParams) -> float:
    """Distance between two frames, ‖p_a - p_b‖ (Pezzato et al. 2025, Eq. 10), straight or along the geodesic [m].

    With ``near`` it saturates, 1 - exp(-d/near): a pull that acts close to the target alone. With ``lead`` it is
    measured from p_a + lead · ṗ_a, so that what rolls or slides on after the horizon is seen to do so.
    """
    a = frame_position(s, p.first) + p.lead * frame_velocity(s, p.first)
    b = frame_position(s, p.second)
    d = wp.length(a - b)
    if p.planar != 0:
        d = plane_distance(s, p.field, wp.vec2(b[0], b[1]), wp.vec2(a[0], a[1]))
    if p.near > 0.0:
        return 1.0 - wp.exp(-d / p.near)
    return d


@wp.struct
class YawParams:
    """Parameters of ``yaw``."""

    of: int
    to: int
    near: float  # [m] the term fades with distance beyond about this; 0 means everywhere
    smooth: float  # [rad] √(ψ² + p²) - p instead of |ψ|: quadratic below about p


@wp.func
def yaw_error(s: StepView, p: YawParams) -> float:
    """Heading error |ψ_a - ψ_b| on the circle (Eq. 10), optionally fading with the distance to the target.

    With ``smooth`` the error counts by MuJoCo MPC's SmoothAbs norm (Howell et al. 2022): small errors cost little.
    """
    a = frame_pose(s, p.of)
    b = frame_pose(s, p.to)
    error = wp.abs(wrap_angle(yaw(wp.transform_get_rotation(a)) - yaw(wp.transform_get_rotation(b))))
    error = wp.sqrt(error * error + p.smooth * p.smooth) - p.smooth
    if p.near > 0.0:
        d = wp.transform_get_translation(a) - wp.transform_get_translation(b)
        error *= wp.exp(-wp.length(wp.vec2(d[0], d[1])) / p.near)
    return error


@wp.struct
class PushAlignmentParams:
    """Parameters of ``push_alignment``."""

    pusher: int
    object: int
    goal: int
    field: int
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
    to_goal = straight
    if p.field >= 0:
        f = s.e * s.fields + p.field
        at = wp.vec2(o[0], o[1])
        path = sample_field(s.field, f, s.field_origin, s.field_cell, at)
        if path - wp.length(at - s.field_center[f]) > s.field_cell:
            to_goal = -field_gradient(s.field, f, s.field_origin, s.field_cell, at)
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
    value: wp.array4d[float]  # [E, 16, rows, columns] work left, in the goal's frame [m]
    origin: wp.array[wp.vec2]  # [E] place of the first cell in the goal's frame [m]
    cell: float  # [m]
    field: int  # distance field of the pusher to the object
    radius: float  # [m] of a circle around the object, outside of which the pusher goes straight
    turn: float  # cost of a metre that the pusher goes, relative to a metre of pushing
    faces: int  # whether the object has sides
    broad: float  # [rad] direction of a broad side in the object's frame
    steer: float  # how far to push beside the middle, as an angle per heading error
    lead: float  # [s] look at where the object would coast to in this time


@wp.func
def shrink(d: float, tolerance: float) -> float:
    """Zero within ± tolerance, d itself beyond 2.5 times that, and continuous."""
    a = wp.abs(d)
    if a < 2.5 * tolerance:
        a = wp.max(a - tolerance, 0.0) * 2.5 / 1.5
    return wp.sign(d) * a


@wp.func
def to_nearest_side(angle: float) -> float:
    """Angle from the nearest multiple of π/2, in [-π/4, π/4] [rad]."""
    return angle - wp.half_pi * wp.round(angle / wp.half_pi)


@wp.func
def swivel(angle: float, error: float) -> float:
    """How far the pusher is from where it would turn an object back by its heading error [rad].

    That is beside the middle of a broad side. Small errors count less.
    """
    off = angle + wp.sign(error) * SWIVEL
    return wp.abs(off - wp.pi * wp.round(off / wp.pi)) * wp.min(wp.abs(error) / LARGEST_STEER, 1.0)


@wp.func
def push_path(s: StepView, p: PushPathParams) -> float:
    """Work left to push an object to the goal around the obstacles, the pusher's own way included [m].

    min over sides d of V(o, d) + turn · walk(r → d), with V from dynamic programming (``warpmpc.cost.push_path``). The
    walk is straight to the sides of a circle about the object that the pusher sees, longer by what obstacles in
    between add. Being a cost-to-go, it rewards the first step to another side of the object already; so it stands for
    the object's distance to the goal and for ``push_alignment`` together.
    """
    r = frame_position(s, p.pusher)
    o = frame_position(s, p.object) + p.lead * frame_velocity(s, p.object)
    goal = frame_pose(s, p.goal)
    g = wp.transform_get_translation(goal)
    heading = yaw(wp.transform_get_rotation(goal))
    c = wp.cos(heading)
    d = wp.sin(heading)
    to_goal = wp.mat22(c, d, -d, c)  # world → the goal's frame
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
            turning = SWIVEL_PRICE * p.turn * wp.min(apart, p.radius) * swivel(angle - error - p.broad, error)
        beside = wp.clamp((1.0 + p.steer) * error, -LARGEST_STEER, LARGEST_STEER) - to_nearest_side(error)
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
        way = p.turn * wp.sqrt(apart * apart + p.radius * p.radius - 2.0 * apart * p.radius * wp.cos(part))
        left = sample_push(p.value, s.e, origin, p.cell, at, angle + part)
        right = sample_push(p.value, s.e, origin, p.cell, at, angle - part)
        best = wp.min(best, wp.min(left, right) + way)
    return best + turning + p.turn * (plane_distance(s, p.field, wp.vec2(o[0], o[1]), wp.vec2(r[0], r[1])) - apart)


@wp.struct
class ContactForceParams:
    """Parameters of ``contact_force``."""

    first: int  # first watched pair
    count: int


@wp.func
def contact_cost(s: StepView, p: ContactForceParams) -> float:
    """Σ ‖F‖ over watched pairs (Eq. 7) [N]."""
    total = float(0.0)
    for i in range(p.count):
        total += wp.length(contact_force(s, p.first + i))
    return total


@wp.struct
class ControlParams:
    """Parameters of ``control_effort`` and ``control_rate``: a range of controls."""

    first: int
    count: int


@wp.func
def control_effort(s: StepView, p: ControlParams) -> float:
    """Σ (u_i / half range)²."""
    total = float(0.0)
    for i in range(p.first, p.first + p.count):
        u = control(s, i) / s.control_scale[i]
        total += u * u
    return total


@wp.func
def control_rate(s: StepView, p: ControlParams) -> float:
    """Σ ((u_i - previous u_i) / half range)²; before the first step stands the control that acts now."""
    total = float(0.0)
    for i in range(p.first, p.first + p.count):
        before = s.last_control[s.e, i]
        if s.t > 1:
            before = s.controls[s.t - 2, s.w, i]
        du = (control(s, i) - before) / s.control_scale[i]
        total += du * du
    return total


@wp.struct
class JointLimitParams:
    """Parameters of ``joint_limit``."""

    coord: wp.array[int]  # limited joint coordinates
    lower: wp.array[float]  # [m or rad] limits moved inwards by the margin
    upper: wp.array[float]


@wp.func
def joint_limit(s: StepView, p: JointLimitParams) -> float:
    """Squared distance of joint positions outside their limits, the limits moved inwards by a margin (STORM)."""
    total = float(0.0)
    for i in range(p.coord.shape[0]):
        q = joint_position(s, p.coord[i])
        outside = wp.max(wp.max(p.lower[i] - q, q - p.upper[i]), 0.0)
        total += outside * outside
    return total


@wp.struct
class JointVelocityParams:
    """Parameters of ``joint_velocity``: a range of joint velocities."""

    first: int
    count: int


@wp.func
def joint_velocity_cost(s: StepView, p: JointVelocityParams) -> float:
    """Σ q̇²."""
    total = float(0.0)
    for i in range(p.first, p.first + p.count):
        total += joint_velocity(s, i) * joint_velocity(s, i)
    return total


@wp.func
def shape_distance(kind: int, size: wp.vec3, p: wp.vec3) -> float:
    """Signed distance from a point in a shape's frame to its surface [m]; sizes are half extents or radius, half."""
    if kind == SPHERE:
        return wp.length(p) - size[0]
    if kind == CAPSULE:
        return wp.length(p - wp.vec3(0.0, 0.0, wp.clamp(p[2], -size[1], size[1]))) - size[0]
    if kind == PLANE:
        return p[2]
    q = wp.vec3(wp.abs(p[0]) - size[0], wp.abs(p[1]) - size[1], wp.abs(p[2]) - size[2])
    if kind == CYLINDER:
        q = wp.vec3(wp.length(wp.vec2(p[0], p[1])) - size[0], wp.abs(p[2]) - size[1], -wp.inf)
    outside = wp.length(wp.vec3(wp.max(q[0], 0.0), wp.max(q[1], 0.0), wp.max(q[2], 0.0)))
    return outside + wp.min(wp.max(q[0], wp.max(q[1], q[2])), 0.0)


@wp.struct
class ObstacleClearanceParams:
    """Parameters of ``obstacle_clearance``."""

    of: int
    pose: wp.array[wp.transform]  # world → obstacle
    kind: wp.array[int]
    size: wp.array[wp.vec3]
    surface: int  # measure to the surface instead of the centre
    radius: float  # [m] of the robot about the frame, subtracted from the distance
    least: float  # [m] shorter distances count as this


@wp.func
def obstacle_clearance(s: StepView, p: ObstacleClearanceParams) -> float:
    """Σ 1/d over the obstacles [1/m]."""
    position = frame_position(s, p.of)
    total = float(0.0)
    for i in range(p.pose.shape[0]):
        local = wp.transform_point(p.pose[i], position)
        d = wp.length(local)
        if p.surface != 0:
            d = shape_distance(p.kind[i], p.size[i], local)
        total += 1.0 / wp.max(d - p.radius, p.least)
    return total


@wp.func
def apart_of(
    corner: wp.array[wp.vec2], first: int, count: int, other: int, others: int, turn: wp.mat22, shift: wp.vec2
) -> wp.vec2:
    """How far another outline's corners are from a convex counter-clockwise outline [m].

    The other's corners are turned and shifted into this one's frame. Returns the least distance from an edge, and the
    greatest over the edges of the least distance outwards: that one is negative for all edges of both outlines if and
    only if they overlap (separating axes).
    """
    nearest = float(wp.inf)
    gap = float(-wp.inf)
    for i in range(count):
        a = corner[first + i]
        edge = corner[first + (i + 1) % count] - a
        size = wp.length(edge)
        outwards = float(wp.inf)
        for k in range(others):
            off = turn * corner[other + k] + shift - a
            along = wp.clamp(wp.dot(off, edge) / (size * size), 0.0, 1.0)
            nearest = wp.min(nearest, wp.length(off - along * edge))
            outwards = wp.min(outwards, (off[0] * edge[1] - off[1] * edge[0]) / size)
        gap = wp.max(gap, outwards)
    return wp.vec2(nearest, gap)


@wp.struct
class OutlineClearanceParams:
    """Parameters of ``outline_clearance``: outlines seen from above, the body's in its frame, then the obstacles'."""

    of: int
    corner: wp.array[wp.vec2]  # [corners] [m]
    first: wp.array[int]  # [outline] first corner
    count: wp.array[int]  # [outline] number of corners
    centre: wp.array[wp.vec2]  # [outline] of a circle around it [m]
    radius: wp.array[float]  # [outline] [m]
    within: float  # [m] greater distances cost nothing


@wp.func
def outline_clearance(s: StepView, p: OutlineClearanceParams) -> float:
    """Σ max(0, 1 - d/within) over the obstacles, with d between their outlines and a body's, seen from above.

    The distance between two convex outlines that do not overlap is one from a corner of either to the other; of those
    that do it is the depth, negative.
    """
    pose = frame_pose(s, p.of)
    c = wp.cos(yaw(wp.transform_get_rotation(pose)))
    d = wp.sin(yaw(wp.transform_get_rotation(pose)))
    position = wp.transform_get_translation(pose)
    at = wp.vec2(position[0], position[1])
    turn = wp.mat22(c, -d, d, c)
    total = float(0.0)
    centre = at + turn * p.centre[0]
    for k in range(1, p.first.shape[0]):
        if wp.length(centre - p.centre[k]) - p.radius[0] - p.radius[k] >= p.within:
            continue
        back = wp.transpose(turn)
        a = apart_of(p.corner, p.first[k], p.count[k], 0, p.count[0], turn, at)
        b = apart_of(p.corner, 0, p.count[0], p.first[k], p.count[k], back, -(back * at))
        gap = wp.max(a[1], b[1])
        least = wp.min(wp.where(gap < 0.0, gap, wp.min(a[0], b[0])), p.within)
        total += 1.0 - least / p.within
    return total


@wp.struct
class OutlineDistanceParams:
    """Parameters of ``outline_distance``."""

    of: int
    object: int
    pose: wp.transform  # object → shape
    kind: int
    size: wp.vec3
    inside: float  # factor on the depth within the outline


@wp.func
def outline_distance(s: StepView, p: OutlineDistanceParams) -> float:
    """Distance from a frame to the outline of an object that stands upright, seen from above [m].

    ‖p_R - p_O‖ (Pezzato et al. 2025, Eq. 10) is least on top of the object; this is least at its sides.
    """
    local = wp.transform_point(wp.transform_inverse(frame_pose(s, p.object)), frame_position(s, p.of))
    at = wp.transform_point(p.pose, local)
    d = shape_distance(p.kind, p.size, wp.vec3(at[0], at[1], 0.0))
    return wp.where(d < 0.0, -p.inside * d, d)


@wp.struct
class HeightParams:
    """Parameters of ``height``."""

    of: int
    target: float  # [m]
    slack: float  # [m] errors up to this cost nothing


@wp.func
def height(s: StepView, p: HeightParams) -> float:
    """|z - target| of a frame (Pezzato et al. 2025, C_ee) [m], or what it exceeds ``slack`` by."""
    return wp.max(wp.abs(frame_position(s, p.of)[2] - p.target) - p.slack, 0.0)


@wp.struct
class OrientationParams:
    """Parameters of ``orientation``."""

    of: int
    to: int
    tilt: int  # compare the directions of the z axes alone


@wp.func
def orientation(s: StepView, p: OrientationParams) -> float:
    """Angle between the orientations of two frames, or between their z axes [rad]."""
    a = frame_rotation(s, p.of)
    b = frame_rotation(s, p.to)
    if p.tilt == 0:
        return rotation_angle(a, b)
    za = wp.quat_rotate(a, wp.vec3(0.0, 0.0, 1.0))
    zb = wp.quat_rotate(b, wp.vec3(0.0, 0.0, 1.0))
    return wp.atan2(wp.length(wp.cross(za, zb)), wp.dot(za, zb))
