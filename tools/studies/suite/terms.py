# SPDX-License-Identifier: Apache-2.0
"""Cost terms of the suite's scenes: what stands, runs and spins should do."""

import warp as wp

import warpmpc

Vec2 = wp.types.vector(length=2, dtype=float)


@wp.struct
class TiltParams:
    """Parameters of ``tilt``."""

    frame: int


@warpmpc.cost_term("tilt")
def tilt(s: warpmpc.StepView, p: TiltParams) -> float:
    """One minus the height of the tip of the frame's z axis: 0 upright, 2 upside down."""
    up = wp.quat_rotate(warpmpc.frame_rotation(s, p.frame), wp.vec3(0.0, 0.0, 1.0))
    return 1.0 - up[2]


@wp.struct
class LowParams:
    """Parameters of ``low``."""

    frame: int
    over: int  # frame that the height is measured from, or -1: the ground
    height: float  # wanted [m]


@warpmpc.cost_term("low")
def low(s: warpmpc.StepView, p: LowParams) -> float:
    """How much height a frame lacks, as a share of what is wanted."""
    z = warpmpc.frame_position(s, p.frame)[2]
    if p.over >= 0:
        z = z - warpmpc.frame_position(s, p.over)[2]
    return wp.max(0.0, 1.0 - z / p.height)


@wp.struct
class StrainParams:
    """Parameters of ``strain``."""

    frame: int
    over: int  # frame that the height is measured from, or -1: the ground
    height: float  # wanted [m]
    motors: int


@warpmpc.cost_term("strain")
def strain(s: warpmpc.StepView, p: StrainParams) -> float:
    """Squared controls of what stands high enough; who still has to get up may strain as it likes."""
    z = warpmpc.frame_position(s, p.frame)[2]
    if p.over >= 0:
        z = z - warpmpc.frame_position(s, p.over)[2]
    total = float(0.0)  # noqa: UP018  (Warp: a variable, no constant)
    for i in range(p.motors):
        u = warpmpc.control(s, i)
        total += u * u
    lack = wp.clamp(1.0 - z / p.height, 0.0, 0.5)
    return total * (1.0 - 2.0 * lack)


@wp.struct
class SlowParams:
    """Parameters of ``slow``."""

    frame: int
    axis: wp.vec3  # direction, in the world or the frame
    turned: int  # whether the axis turns with the frame
    speed: float  # wanted [m/s]


@warpmpc.cost_term("slow")
def slow(s: warpmpc.StepView, p: SlowParams) -> float:
    """How much speed along an axis a frame lacks, as a share of what is wanted; backwards costs more than one."""
    axis = p.axis
    if p.turned != 0:
        axis = wp.quat_rotate(warpmpc.frame_rotation(s, p.frame), axis)
    return wp.max(0.0, 1.0 - wp.dot(warpmpc.frame_velocity(s, p.frame), axis) / p.speed)


@wp.struct
class SpinParams:
    """Parameters of ``spin``."""

    joint: int
    speed: float  # wanted, with its sign [rad/s]


@warpmpc.cost_term("spin")
def spin(s: warpmpc.StepView, p: SpinParams) -> float:
    """How much of its wanted speed a joint lacks, as a share of it."""
    return wp.max(0.0, 1.0 - warpmpc.joint_velocity(s, p.joint) / p.speed)


@wp.struct
class AwayParams:
    """Parameters of ``away``."""

    frame: int
    axis: wp.vec3  # of the frame, that is to point at something
    to: int  # frame it is to point at


@warpmpc.cost_term("away")
def away(s: warpmpc.StepView, p: AwayParams) -> float:
    """One minus the cosine between an axis of a frame and the way to another one."""
    way = wp.normalize(warpmpc.frame_position(s, p.to) - warpmpc.frame_position(s, p.frame))
    return 1.0 - wp.dot(wp.quat_rotate(warpmpc.frame_rotation(s, p.frame), p.axis), way)


@wp.struct
class WalkParams:
    """Parameters of ``stride`` and ``footing``."""

    robot: int
    torso: int  # frame whose x axis is ahead
    head: int  # frame
    left: int  # frames of the feet
    right: int
    low: float  # [m] of the head above the feet: who is down gets up first
    high: float  # [m] from here on it walks at full speed
    speed: float  # wanted [m/s]
    lead: float  # [s] ``footing`` looks so far ahead


@wp.func
def feet(s: warpmpc.StepView, left: int, right: int) -> wp.vec3:
    """The middle of the feet [m]."""
    return 0.5 * (warpmpc.frame_position(s, left) + warpmpc.frame_position(s, right))


@wp.func
def upright(s: warpmpc.StepView, head: int, left: int, right: int, low: float, high: float) -> float:
    """From 0, down, to 1, up: by how high the head is above the feet."""
    height = warpmpc.frame_position(s, head)[2] - feet(s, left, right)[2]
    return wp.clamp((height - low) / (high - low), 0.0, 1.0)


@wp.func
def excess(s: warpmpc.StepView, p: WalkParams) -> Vec2:
    """How much faster the centre of mass is than wanted [m/s]; who is down is not to go anywhere."""
    ahead = wp.quat_rotate(warpmpc.frame_rotation(s, p.torso), wp.vec3(1.0, 0.0, 0.0))
    up = upright(s, p.head, p.left, p.right, p.low, p.high)
    speed = up * p.speed / wp.max(wp.sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1]), 1.0e-6)
    v = warpmpc.centre_of_mass_velocity(s, p.robot)
    return Vec2(v[0] - speed * ahead[0], v[1] - speed * ahead[1])


@warpmpc.residual_term("stride")
def stride(s: warpmpc.StepView, p: WalkParams) -> Vec2:
    """Horizontal velocity of the centre of mass, less the wanted one [m/s]; nothing as long as it is down."""
    return upright(s, p.head, p.left, p.right, p.low, p.high) * excess(s, p)


@warpmpc.residual_term("footing")
def footing(s: warpmpc.StepView, p: WalkParams) -> Vec2:
    """Where the centre of mass would fall to, were it not for the wanted speed, less the middle of the feet [m]."""
    r = warpmpc.centre_of_mass(s, p.robot) - feet(s, p.left, p.right)
    return Vec2(r[0], r[1]) + p.lead * excess(s, p)


@wp.struct
class RhythmParams:
    """Parameters of ``rhythm``."""

    joint: int
    phase: float  # when the joint is at its highest, as a share of the cycle
    cadence: float  # [1/s] cycles
    low: float  # lowest position [rad]
    high: float  # highest position [rad]


@warpmpc.cost_term("rhythm")
def rhythm(s: warpmpc.StepView, p: RhythmParams) -> float:
    """Squared distance [rad²] of a joint from a swing between two positions that follows a clock."""
    turn = 2.0 * wp.pi * (p.cadence * warpmpc.step_time(s) - p.phase)
    off = warpmpc.joint_position(s, p.joint) - 0.5 * (p.high + p.low) - 0.5 * (p.high - p.low) * wp.cos(turn)
    return off * off


@wp.struct
class SwingParams:
    """Parameters of ``swing``."""

    root: int  # frames at the ends of two rods of one mass
    middle: int
    tip: int


@warpmpc.residual_term("swing")
def swing(s: warpmpc.StepView, p: SwingParams) -> float:
    """Energy that two like rods, root to middle and on to the tip, lack to stand up at rest: 1 where they hang.

    A rod's kinetic energy is m/6 (v₁² + v₁·v₂ + v₂²), v₁ and v₂ being the velocities of its ends.
    """
    a, b, c = warpmpc.frame_position(s, p.root), warpmpc.frame_position(s, p.middle), warpmpc.frame_position(s, p.tip)
    v, w = warpmpc.frame_velocity(s, p.middle), warpmpc.frame_velocity(s, p.tip)
    kinetic = (2.0 * wp.dot(v, v) + wp.dot(v, w) + wp.dot(w, w)) / 6.0
    top = 1.5 * wp.length(b - a) + 0.5 * wp.length(c - b)  # of both middles above the root, standing
    return (top + 1.5 * a[2] - b[2] - 0.5 * c[2] - kinetic / 9.81) / (2.0 * top)


@wp.struct
class RiseParams:
    """Parameters of ``rise``."""

    frame: int
    height: float  # wanted, above the world's origin [m]


@warpmpc.residual_term("rise")
def rise(s: warpmpc.StepView, p: RiseParams) -> float:
    """Height [m] that a frame lacks, or has too much, once all its speed has become height."""
    v = warpmpc.frame_velocity(s, p.frame)
    return p.height - warpmpc.frame_position(s, p.frame)[2] - 0.5 * wp.dot(v, v) / 9.81


@wp.struct
class PullParams:
    """Parameters of ``pull``."""

    frame: int
    to: int  # frame it is to come to
    near: float  # [m]


@warpmpc.residual_term("pull")
def pull(s: warpmpc.StepView, p: PullParams) -> wp.vec3:
    """The way from a frame to another one, shortened to ``near`` [m] at most: what is far off does not matter much."""
    way = warpmpc.frame_position(s, p.to) - warpmpc.frame_position(s, p.frame)
    return way / wp.sqrt(1.0 + wp.dot(way, way) / (p.near * p.near))


@wp.func
def raised(s: warpmpc.StepView, frame: int, over: int, low: float, high: float) -> float:
    """From 0 to 1: how high a frame is, above another one or, where that is -1, above the ground."""
    z = warpmpc.frame_position(s, frame)[2]
    if over >= 0:
        z = z - warpmpc.frame_position(s, over)[2]
    return wp.clamp((z - low) / (high - low), 0.0, 1.0)


@wp.func
def ahead_of(s: warpmpc.StepView, frame: int) -> wp.vec3:
    """Where the x axis of a frame points to on the map, or the world's where the frame is -1; a unit vector."""
    x = wp.vec3(1.0, 0.0, 0.0)
    if frame >= 0:
        x = wp.quat_rotate(warpmpc.frame_rotation(s, frame), x)
    return wp.normalize(wp.vec3(x[0], x[1], 0.0))


@wp.struct
class PaceParams:
    """Parameters of ``pace``."""

    robot: int
    frame: int  # that is to be high
    over: int  # frame that the height is measured from, or -1: the ground
    ahead: int  # frame whose x axis is ahead, or -1: the world's is
    low: float  # [m] from here down speed is worth nothing
    high: float  # [m] from here up it is worth all
    speed: float  # [m/s] from here on more is worth nothing


@warpmpc.cost_term("pace")
def pace(s: warpmpc.StepView, p: PaceParams) -> float:
    """How much speed ahead is lacking, as a share of what is wanted; only what is up has any.

    A product: where height and speed are separate terms, a fall forwards is fast, and where speed is not asked of
    who is down, a fall saves it.
    """
    share = wp.min(wp.dot(warpmpc.centre_of_mass_velocity(s, p.robot), ahead_of(s, p.ahead)) / p.speed, 1.0)
    return 1.0 - raised(s, p.frame, p.over, p.low, p.high) * share


@wp.struct
class TreadParams:
    """Parameters of ``tread``."""

    robot: int
    torso: int  # frame whose x axis is ahead
    head: int  # frame
    left: int  # frames of the feet
    right: int
    low: float  # [m] of the head above the ground: who is down is to go nowhere
    high: float  # [m] from here on it runs
    speed: float  # [m/s] wanted
    more: float  # [m/s] faster than now, until it is as fast as wanted
    lead: float  # [s] it looks so far ahead


@warpmpc.residual_term("tread")
def tread(s: warpmpc.StepView, p: TreadParams) -> Vec2:
    """Where the centre of mass would fall to, were it to run a little faster, less the middle of the feet [m].

    As ``footing``, for who is far from the wanted speed: it leans by ``lead`` times ``more``, not by all that lacks.
    """
    ahead = ahead_of(s, p.torso)
    v = warpmpc.centre_of_mass_velocity(s, p.robot)
    wanted = raised(s, p.head, -1, p.low, p.high) * wp.min(p.speed, wp.dot(v, ahead) + p.more)
    r = warpmpc.centre_of_mass(s, p.robot) - feet(s, p.left, p.right) + p.lead * (v - wanted * ahead)
    return Vec2(r[0], r[1])
