# SPDX-License-Identifier: Apache-2.0
"""Cost terms for a hand with two fingers that picks an object up. See ``costs`` for their signature."""

import warp as wp

from .view import (
    StepView,
    control,
    frame_position,
    frame_rotation,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class ApproachParams:
    """Parameters of ``approach``."""

    hand: int
    object: int
    width: float  # [m] how far beside the object's centre the hand may be to come down on it
    rise: float  # [m] how far above it farther out


@wp.func
def approach(s: StepView, p: ApproachParams) -> float:
    """Distance d of a grasp point to an object's centre, √(d² + 0.01²) - 0.01, kept above when beside the object [m].

    With the object at a distance h from the hand's z axis the grasp point ought to be rise (1 - exp(-(h/width)⁸))
    above it; what is missing is added twice. Without it fingers stop on top of the object or against what it lies on,
    from where every way on is longer.
    """
    d = frame_position(s, p.object) - frame_position(s, p.hand)
    local = wp.quat_rotate_inv(frame_rotation(s, p.hand), d)
    r = (local[0] * local[0] + local[1] * local[1]) / (p.width * p.width)
    r = r * r
    low = wp.max(p.rise * (1.0 - wp.exp(-r * r)) + d[2], 0.0)
    return wp.sqrt(wp.length_sq(d) + 1.0e-4) - 0.01 + 2.0 * low


@wp.struct
class FingerAlignmentParams:
    """Parameters of ``finger_alignment``."""

    hand: int
    object: int


@wp.func
def finger_alignment(s: StepView, p: FingerAlignmentParams) -> float:
    """2 (1 - Σ aᵢ⁴) with a the hand's y axis in a box's frame: zero if fingers meet faces, whichever side is up.

    For an upright box and a level axis at an angle ψ to its face that is (1 - cos 4ψ)/2.
    """
    a = wp.quat_rotate(frame_rotation(s, p.hand), wp.vec3(0.0, 1.0, 0.0))
    a = wp.quat_rotate_inv(frame_rotation(s, p.object), a)
    a = wp.cw_mul(a, a)
    return 2.0 * (1.0 - wp.dot(a, a))


@wp.struct
class GripperParams:
    """Parameters of ``gripper``."""

    hand: int
    object: int
    near: float  # [m]
    finger: wp.array[int]  # controls of the fingers
    middle: wp.array[float]  # of each control's range


@wp.func
def gripper(s: StepView, p: GripperParams) -> float:
    """(1 + ū)/2 within a distance of the object, else 1 + (1 - ū)/2, with ū the fingers' mean control, -1 to 1.

    It wants the fingers to close with all they have at the object and to open away from it. Away never costs less:
    were it not so, a hand with open fingers would stop short of the object.
    """
    mean = float(0.0)
    for i in range(p.finger.shape[0]):
        mean += (control(s, p.finger[i]) - p.middle[i]) / s.control_scale[p.finger[i]]
    mean /= float(p.finger.shape[0])
    if wp.length(frame_position(s, p.object) - frame_position(s, p.hand)) < p.near:
        return 0.5 * (1.0 + mean)
    return 1.0 + 0.5 * (1.0 - mean)
