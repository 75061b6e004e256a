# SPDX-License-Identifier: Apache-2.0
"""Terms of a hand with two fingers that picks an object up."""

from typing import Annotated, Any

import warp as wp
from pydantic import Field

from ...kernels.cost.view import StepView, control, frame_position, frame_rotation
from ...scene.types import NonNegative, Positive
from ..binding import Binding
from ..keys import Frame, Object, TermKeys, term


class Approach(TermKeys):
    """Distance of a grasp point to an object [m]."""

    hand: Frame
    """Frame between the fingertips; its z axis points back to the hand."""
    object: Frame
    """Object to be gripped at its centre."""
    width: Positive
    """How far beside the object the hand may be to come down on it [m]: about half of what open fingers leave free."""
    rise: NonNegative
    """How far above the object the hand stays farther out [m]: clears the object's top."""


@term("approach", Approach)
def approach(s: StepView, p: Approach.Params) -> float:
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


class FingerAlignment(TermKeys):
    """Error of the fingers in meeting a box's faces, 0 to 4/3."""

    hand: Frame
    """Frame whose y axis is the line along which the fingers close."""
    object: Object
    """Box."""

    def bind(self, p: Any, b: Binding) -> None:
        """Refuse what has no faces."""
        if (kind := b.object_shape(self.object, "object").kind) != "box":
            raise b.error("fingers meet the faces of a box", "object", found=kind)


@term("finger_alignment", FingerAlignment)
def finger_alignment(s: StepView, p: FingerAlignment.Params) -> float:
    """Misalignment of fingers and the faces of a box, 2 (1 - Σ aᵢ⁴), a the hand's y axis in the box's frame.

    For an upright box and a level axis at an angle ψ to its face that is (1 - cos 4ψ)/2.
    """
    a = wp.quat_rotate(frame_rotation(s, p.hand), wp.vec3(0.0, 1.0, 0.0))
    a = wp.quat_rotate_inv(frame_rotation(s, p.object), a)
    a = wp.cw_mul(a, a)
    return 2.0 * (1.0 - wp.dot(a, a))


class Gripper(TermKeys):
    """Fingers close at an object and open away from it, 0 to 2."""

    hand: Frame
    """Frame between the fingertips."""
    object: Frame
    """Object to be gripped."""
    near: Positive
    """Distance from the hand to the object's centre within which the fingers close [m]."""
    fingers: Annotated[tuple[str, ...], Field(min_length=1)]
    """Controls of the fingers, ``robot/joint``; the upper end of their range opens."""

    derived = {"finger": wp.array[int], "middle": wp.array[float]}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the controls of the fingers and the middle of each one's range."""
        controls = [b.control(name, "fingers") for name in self.fingers]
        p.finger = b.array(controls, dtype=int)
        p.middle = b.array(0.5 * (b.layout.control_lower + b.layout.control_upper)[controls], dtype=float)


@term("gripper", Gripper)
def gripper(s: StepView, p: Gripper.Params) -> float:
    """Fingers that are open near the object, (1 + ū)/2, or closed elsewhere, 1 + (1 - ū)/2, ū the mean control.

    It wants the fingers to close with all they have at the object and to open away from it. Away never costs less:
    were it not so, a hand with open fingers would stop short of the object.
    """
    mean = wp.float32(0.0)
    for i in range(p.finger.shape[0]):
        mean += (control(s, p.finger[i]) - p.middle[i]) / s.control_scale[p.finger[i]]
    mean /= float(p.finger.shape[0])
    if wp.length(frame_position(s, p.object) - frame_position(s, p.hand)) < p.near:
        return 0.5 * (1.0 + mean)
    return 1.0 + 0.5 * (1.0 - mean)
