# SPDX-License-Identifier: Apache-2.0
"""Cost terms of the suite's scenes: what stands, runs and spins should do."""

import warp as wp

import warpmpc


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
