# SPDX-License-Identifier: Apache-2.0
"""Terms of joints: limits, speeds, accelerations and jerks."""

from typing import Annotated, Any

import numpy as np
import warp as wp
from pydantic import Field

from ...kernels.cost.view import StepView, joint_acceleration, joint_jerk, joint_position, joint_velocity
from ...scene.model.joints import driving
from ...scene.types import Fraction, NonNegative, Positives
from ..binding import Binding
from ..keys import TermKeys, term
from ..residual import residual

JointNames = Annotated[tuple[str, ...], Field(min_length=1)]
_NO_LIMIT = 1e6
"""Limits of an asset from here on are no limits."""


class Joints(TermKeys):
    """All joints of one robot, or joints by name."""

    of: str | None = None
    """Robot; the first when left out."""
    joints: JointNames | None = None
    """Joints, ``robot/joint`` or the joint's own name, in place of ``of``."""

    def axes(self, b: Binding) -> np.ndarray:
        """Degrees of freedom that slide or turn about their own axes, the only ones with a coordinate each."""
        dofs = np.array(b.dofs(self.of, self.joints), dtype=int)
        return dofs[b.layout.dof_coord[dofs] >= 0]


class JointVelocity(Joints):
    """Velocities of joints."""

    derived = {"joint": wp.array[int], "numbers": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the joint velocities."""
        dofs = b.dofs(self.of, self.joints)
        p.joint, p.numbers = b.array(dofs, dtype=int), len(dofs)


@residual("joint_velocity", JointVelocity)
def joint_velocity_cost(s: StepView, p: JointVelocity.Params, i: int) -> float:
    """Squared joint velocities, Σ q̇²."""
    return joint_velocity(s, p.joint[i])


class Posture(Joints):
    """Positions of joints."""

    derived = {"coord": wp.array[int], "target": wp.array[float], "numbers": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the joint coordinates and where they start [m or rad]."""
        coords = b.layout.dof_coord[self.axes(b)]
        p.coord, p.numbers = b.array(coords, dtype=int), len(coords)
        p.target = b.array(b.layout.joint_q[coords], dtype=float)


@residual("posture", Posture)
def posture(s: StepView, p: Posture.Params, i: int) -> float:
    """Squared distance from the start posture q₀, Σ (q - q₀)² (STORM's null-space cost)."""
    return joint_position(s, p.coord[i]) - p.target[i]


class JointLimit(TermKeys):
    """Squared distance outside the joint limits."""

    of: str | None = None
    """Robot; all when left out."""
    joints: JointNames | None = None
    """Joints with limits, ``robot/joint`` or the joint's own name, in place of ``of``."""
    margin: NonNegative = 0.05
    """Limits are moved inwards by this [m or rad]."""

    derived = {"coord": wp.array[int], "lower": wp.array[float], "upper": wp.array[float], "numbers": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Find joints with limits [m or rad]."""
        layout = b.layout
        span = np.abs(layout.dof_upper - layout.dof_lower)
        if self.joints is not None:
            dofs = b.dofs(self.of, self.joints)
            if free := [layout.dof_name[i] for i in dofs if span[i] >= _NO_LIMIT]:
                raise b.error("this joint has no limits", "joints", found=free[0])
        else:
            own = b.owned(self.of, b.dof_joints)
            dofs = [i for i in own if layout.dof_coord[i] >= 0 and span[i] < _NO_LIMIT]
        p.coord, p.numbers = b.array(layout.dof_coord[dofs], dtype=int), len(dofs)
        p.lower = b.array(layout.dof_lower[dofs] + self.margin, dtype=float)
        p.upper = b.array(layout.dof_upper[dofs] - self.margin, dtype=float)


@residual("joint_limit", JointLimit)
def joint_limit(s: StepView, p: JointLimit.Params, i: int) -> float:
    """Squared distance of joint positions outside their limits, the limits moved inwards by a margin (STORM)."""
    q = joint_position(s, p.coord[i])
    return wp.max(wp.max(p.lower[i] - q, q - p.upper[i]), 0.0)


class Stop(Joints):
    """Speed from which joints do not stop within the horizon."""

    acceleration: Positives | None = None
    """Greatest acceleration [m/s² or rad/s²], one or one per joint; the drives' where they take accelerations."""

    derived = {"joint": wp.array[int], "acceleration": wp.array[float]}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the joint velocities and the greatest acceleration of each."""
        dofs = self.axes(b)
        if self.acceleration is not None:
            limit = b.spread(self.acceleration, len(dofs), "acceleration")
        else:
            driven = driving(b.layout, dofs, "acceleration")
            if self.joints is None:
                dofs, driven = dofs[driven >= 0], driven[driven >= 0]
            if not len(dofs) or (driven < 0).any():
                raise b.error(
                    "no drive of these joints takes accelerations: give the greatest one",
                    "acceleration",
                    found=[b.layout.dof_name[dof] for dof in dofs[driven < 0]] or None,
                )
            # what it can brake with, whichever way it goes
            limit = np.minimum(-b.layout.control_lower[driven], b.layout.control_upper[driven])
        p.joint, p.acceleration = b.array(dofs, dtype=int), b.array(limit, dtype=float)


@term("stop", Stop)
def stop(s: StepView, p: Stop.Params) -> float:
    """Joint speeds too high to stop within the horizon, Σ max(0, |q̇| - v_h)², v_h = a_max Σ_{k≥h} dt_k (STORM).

    That is STORM's Eq. 9, in [m²/s² or rad²/s²]. Step h, which led here, counts among those that are left, so that
    the end of the horizon allows what one last step could stop.
    """
    left = s.step_end[s.step_end.shape[0] - 1] - s.step_end[s.t - 1]
    total = wp.float32(0.0)
    for i in range(p.joint.shape[0]):
        total += outside(joint_velocity(s, p.joint[i]), left * p.acceleration[i])
    return total


@wp.func
def outside(value: float, bound: float) -> float:
    """Squared distance of a value outside ± a bound."""
    d = wp.max(wp.abs(value) - bound, 0.0)
    return d * d


class JointBounds(Joints):
    """Squared distance outside joint limits of all kinds."""

    margin: Fraction = 0.05
    """Share that every range is shrunk by, about its middle."""
    velocity: Positives | None = None
    """Greatest speed [m/s or rad/s], one or one per joint; the asset's when left out."""
    acceleration: Positives | None = None
    """Greatest acceleration [m/s² or rad/s²], one or one per joint; none when left out."""
    jerk: Positives | None = None
    """Greatest jerk [m/s³ or rad/s³], one or one per joint; none when left out."""

    derived = dict.fromkeys(("joint", "coord", "driven"), wp.array[int]) | dict.fromkeys(
        ("middle", "reach", "velocity", "acceleration", "jerk"), wp.array[float]
    )

    def bind(self, p: Any, b: Binding) -> None:
        """Find joints and their limits, shrunk; infinite where there are none."""
        layout, dofs = b.layout, self.axes(b)
        lower, upper = (a[dofs].astype(np.float64) for a in (layout.dof_lower, layout.dof_upper))
        limited, left = upper - lower < _NO_LIMIT, 1.0 - self.margin
        p.joint, p.coord = b.array(dofs, dtype=int), b.array(layout.dof_coord[dofs], dtype=int)
        p.driven = b.array(driving(layout, dofs, "acceleration"), dtype=int)
        p.middle = b.array(np.where(limited, 0.5 * (lower + upper), 0.0), dtype=float)
        p.reach = b.array(np.where(limited, 0.5 * left * (upper - lower), np.inf), dtype=float)
        for key in ("velocity", "acceleration", "jerk"):
            given = getattr(self, key)
            values = layout.dof_speed[dofs] if key == "velocity" else np.full(len(dofs), np.inf)
            if given is not None:
                values = np.array(b.spread(given, len(dofs), key), dtype=np.float32)
            setattr(p, key, b.array(np.where(values < _NO_LIMIT, left * values, np.inf), dtype=float))


@term("joint_bounds", JointBounds)
def joint_bounds(s: StepView, p: JointBounds.Params) -> float:
    """Squared distance of joint positions, velocities, accelerations and jerks outside their limits (STORM), shrunk.

    The sum is over joints and kinds, each in the square of its own unit. Accelerations and jerks are differences of
    the velocities at the ends of steps, or controls where a drive takes accelerations.
    """
    total = wp.float32(0.0)
    for i in range(p.joint.shape[0]):
        joint = p.joint[i]
        total += outside(joint_position(s, p.coord[i]) - p.middle[i], p.reach[i])
        total += outside(joint_velocity(s, joint), p.velocity[i])
        total += outside(joint_acceleration(s, joint, p.driven[i]), p.acceleration[i])
        total += outside(joint_jerk(s, joint, p.driven[i]), p.jerk[i])
    return total


class Smoothness(Joints):
    """Squared accelerations and jerks of joints."""

    acceleration: NonNegative = 1.0
    """Factor on q̈² [(rad/s²)⁻² or (m/s²)⁻²]."""
    jerk: NonNegative = 0.0
    """Factor on q⃛² [(rad/s³)⁻² or (m/s³)⁻²]."""

    derived = {"joint": wp.array[int], "driven": wp.array[int]}

    def bind(self, p: Any, b: Binding) -> None:
        """Find joint velocities, and the control that is the joint's acceleration, or -1."""
        dofs = self.axes(b)
        p.joint = b.array(dofs, dtype=int)
        p.driven = b.array(driving(b.layout, dofs, "acceleration"), dtype=int)


@term("smoothness", Smoothness)
def smoothness(s: StepView, p: Smoothness.Params) -> float:
    """Joint accelerations and jerks, Σ α q̈² + ζ q⃛², computed as in ``joint_bounds``."""
    total = wp.float32(0.0)
    for i in range(p.joint.shape[0]):
        a = joint_acceleration(s, p.joint[i], p.driven[i])
        j = joint_jerk(s, p.joint[i], p.driven[i])
        total += p.acceleration * a * a + p.jerk * j * j
    return total
