# SPDX-License-Identifier: Apache-2.0
"""Residuals that are numbers of one kind: of joints, controls, sensors and contacts.

Feet that are to be lifted in turn: heights that follow a clock.
"""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import warp as wp
from pydantic import Field

from ...kernels.cost.points import Wanted, wanted
from ...kernels.cost.view import (
    StepView,
    contact_force,
    control,
    frame_position,
    joint_position,
    joint_velocity,
    sensor,
    step_time,
)
from ...scene.types import Finite, Floats, Names, NonNegative
from ..binding import Binding
from ..keys import Frame, TermKeys
from ..norms import NormKey, NormKind
from ..residual import residual
from .joints import JointNames
from .residuals import Axes, ResidualKeys, Target


class Numbers(ResidualKeys):
    """Numbers of one kind, by their indices."""

    derived = {"index": wp.array[int], "wanted": Wanted, "numbers": int}

    def pick(self, p: Any, index: Sequence[int], b: Binding, target: Sequence[float | str] | None = None) -> None:
        """Fill the parameters with indices and with what the numbers shall be."""
        p.index, p.numbers = b.array(np.array(index, dtype=int), dtype=int), len(index)
        p.wanted = b.wanted(self.target if target is None else target, len(index))


class JointNumbers(Numbers):
    """Numbers of joints."""

    of: str | None = None
    """Robot; the first when left out."""
    joints: JointNames | None = None
    """Joints, ``robot/joint`` or the joint's own name, in place of ``of``."""

    def bind(self, p: Any, b: Binding) -> None:
        """Find the joint velocities."""
        self.pick(p, b.dofs(self.of, self.joints), b)


@residual("joint_velocity_residual", JointNumbers)
def joint_velocity_residual(s: StepView, p: JointNumbers.Params, i: int) -> float:
    """Norm of joint velocities less the wanted ones [m/s or rad/s]."""
    return joint_velocity(s, p.index[i]) - wanted(s, p.wanted, i)


class PostureNumbers(JointNumbers):
    """Positions of joints."""

    target: Target | None = None
    """Positions [m or rad]: numbers or names of scalars, one or one for each joint; the start when left out."""

    def bind(self, p: Any, b: Binding) -> None:
        """Find the joint coordinates."""
        coords = b.layout.dof_coord[b.dofs(self.of, self.joints)]
        if self.joints and (coords < 0).any():
            raise b.error(
                "a joint here has no single coordinate: free and ball joints have rotation_residual and "
                "position_residual",
                "joints",
                found=list(self.joints),
            )
        coords = coords[coords >= 0]
        self.pick(p, coords, b, tuple(b.layout.joint_q[coords].tolist()) if self.target is None else self.target)


@residual("posture_residual", PostureNumbers)
def posture_residual(s: StepView, p: PostureNumbers.Params, i: int) -> float:
    """Norm of joint positions less the wanted ones [m or rad]."""
    return joint_position(s, p.index[i]) - wanted(s, p.wanted, i)


class Controls(Numbers):
    """Controls."""

    of: str | None = None
    """Robot; all when left out."""
    controls: JointNames | None = None
    """Controls, ``robot/joint`` or ``robot/actuator``, in place of ``of``."""

    def bind(self, p: Any, b: Binding) -> None:
        """Find the controls."""
        if self.controls is None:
            self.pick(p, b.owned(self.of, b.layout.control_name), b)
            return
        if self.of is not None:
            what = "name controls or their robot, not both: leave out 'of'"
            raise b.error(what, "controls", found=self.of)
        self.pick(p, [b.control(name, "controls") for name in self.controls], b)


@residual("control_residual", Controls)
def control_residual(s: StepView, p: Controls.Params, i: int) -> float:
    """Norm of controls less the wanted ones, in their own units."""
    return control(s, p.index[i]) - wanted(s, p.wanted, i)


class Sensors(Numbers):
    """Sensors of MJCF files."""

    sensors: Names
    """Sensors, ``robot/sensor`` or the sensor's own name, with all their numbers."""

    def bind(self, p: Any, b: Binding) -> None:
        """Find the sensors' numbers."""
        starts = [b.sensor(name, "sensors") for name in self.sensors]
        sizes = [int(b.layout.sensor_dim[b.layout.sensor_start.tolist().index(start)]) for start in starts]
        self.pick(p, [start + k for start, size in zip(starts, sizes, strict=True) for k in range(size)], b)


@residual("sensor_residual", Sensors)
def sensor_residual(s: StepView, p: Sensors.Params, i: int) -> float:
    """Norm of what sensors show less what they shall, in their own units."""
    return sensor(s, p.index[i]) - wanted(s, p.wanted, i)


class Contact(Numbers):
    """Contact of pairs of entities."""

    between: tuple[str, str]
    """Two entities or groups (obstacles, objects, robots)."""
    least: NonNegative = 0.0
    """They touch where they push harder than this [N]."""

    def bind(self, p: Any, b: Binding) -> None:
        """Watch the pairs."""
        first, count = b.watch(*self.between, "between")
        self.pick(p, range(first, first + count), b)


@residual("contact_residual", Contact)
def contact_residual(s: StepView, p: Contact.Params, i: int) -> float:
    """Norm of which pairs touch, 1 or 0, less which shall."""
    touches = wp.where(wp.length(contact_force(s, p.index[i])) > p.least, 1.0, 0.0)
    return touches - wanted(s, p.wanted, i)


class ContactForceNumbers(Numbers):
    """Net contact forces on the first of each pair [N]."""

    between: tuple[str, str]
    """Two entities or groups (obstacles, objects, robots)."""
    axes: Axes = "xyz"
    """Axes of the world that count."""

    def bind(self, p: Any, b: Binding) -> None:
        """Watch the pairs; a number's index is 3 times its pair, and its axis."""
        first, count = b.watch(*self.between, "between")
        axes = ["xyz".index(axis) for axis in self.axes]
        self.pick(p, [3 * pair + axis for pair in range(first, first + count) for axis in axes], b)


@residual("contact_force_residual", ContactForceNumbers)
def contact_force_residual(s: StepView, p: ContactForceNumbers.Params, i: int) -> float:
    """Norm of net contact forces less the wanted ones [N]."""
    at = p.index[i]
    return contact_force(s, at // 3)[at % 3] - wanted(s, p.wanted, i)


@wp.func
def swing_height(cycles: float, phase: float, swing: float) -> float:
    """Height that a foot shall have at this time, as a share of its lift: a parabola, then zero.

    Args:
        cycles: Time in cycles.
        phase: Share of the cycle at which the foot is lifted.
        swing: Share of the cycle that it is in the air.
    """
    since = cycles - phase
    x = (since - wp.floor(since)) / swing
    return 4.0 * wp.max(x * (1.0 - x), 0.0)


class Gait(TermKeys):
    """Feet that are lifted in turn."""

    feet: Annotated[tuple[Frame, ...], Field(min_length=1)]
    """Frames at the feet."""
    phases: Floats
    """When each foot is lifted, as a share of the cycle; (0, 0.5, 0.5, 0) is a trot of left and right foot in front,
    left and right behind."""
    cadence: NonNegative
    """Cycles in a second [1/s]."""
    swing: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)] = 0.5
    """Share of the cycle that a foot is in the air."""
    height: Target
    """How high feet are lifted [m]: a number or the name of a scalar, one or one for each foot; 0 stands."""
    stand: Finite = 0.0
    """Height of the frames of feet that stand [m]: the feet's radius where the frames are in their middle."""
    norm: NormKey = NormKind.QUADRATIC
    """quadratic, or { kind, p, q }: l2, l22, cosh, power, smooth_abs, smooth_abs2, rectify."""

    derived = {"phase": wp.array[float], "wanted": Wanted, "numbers": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Set the phase and the height of each foot [m]."""
        if len(self.phases) != len(self.feet):
            raise b.error(f"give one phase for each of the {len(self.feet)} feet", "phases", found=list(self.phases))
        p.phase, p.numbers = b.array(list(self.phases), dtype=float), len(self.feet)
        p.wanted = b.wanted(self.height, len(self.feet), key="height")


@residual("gait_residual", Gait)
def gait_residual(s: StepView, p: Gait.Params, i: int) -> float:
    """Norm of feet's heights less those of a gait: each foot is lifted in its turn, on level ground [m]."""
    lifted = wanted(s, p.wanted, i) * swing_height(p.cadence * step_time(s), p.phase[i], p.swing)
    return frame_position(s, p.feet[i])[2] - p.stand - lifted
