# SPDX-License-Identifier: Apache-2.0
"""Residuals in space and what their norms cost: frames, centres of mass, momenta.

A residual is a few numbers that shall be zero: components of a vector, less what is wanted.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
import warp as wp
from pydantic import Field

from ...kernels.cost.norms import norm_part, norm_total
from ...kernels.cost.points import Points, Wanted, points_angular_velocity, points_position, points_velocity, wanted
from ...kernels.cost.view import StepView, frame_rotation
from ...scene.types import Finite, Names, NonNegative, OneOrSeveral
from ..binding import Binding
from ..keys import Frame, TermKeys, term
from ..norms import NormKey, NormKind
from ..residual import residual
from ..term import CostTerm, Residual
from .places import CentreOfMass, Place, Point, massive, place_points, points_struct

Target = Annotated[tuple[Finite | str, ...], Field(min_length=1), OneOrSeveral]
"""One number or name of a scalar, or one for each of the residual's numbers."""
Axes = Annotated[str, Field(pattern="^(x?y?z?)$", min_length=1)]


class ResidualKeys(TermKeys):
    """A residual and its norm."""

    target: Target | None = None
    """Wanted values of the residual's numbers: numbers or names of scalars, one or one for each; 0 when left out."""
    norm: NormKey = NormKind.QUADRATIC
    """quadratic, or { kind, p, q }: l2, l22, cosh, power, smooth_abs, smooth_abs2, rectify."""

    def of_axes(self, p: Any, points: Sequence[Point], axes: str, b: Binding) -> None:
        """Fill the parameters of a residual along some axes."""
        p.points, p.heading = points_struct(points, b), -1
        p.axis = b.array(np.array(["xyz".index(axis) for axis in axes]), dtype=int)
        p.wanted = b.wanted(self.target, len(axes))


SPATIAL = {"points": Points, "axis": wp.array[int], "heading": int, "wanted": Wanted}
"""Parameters of residuals in space: axes that count, in their order; the frame with whose heading they turn or -1."""


def spatial(name: str, keys: type[ResidualKeys]) -> Callable[[Callable], CostTerm]:
    """Turn a function ``(s, p) -> wp.vec3``, a vector in the world's frame, into a term: the norm of its components.

    Args:
        name: What scene files call it.
        keys: Its keys, whose ``Params`` have the fields of :data:`SPATIAL`.
    """

    def decorate(function: Callable) -> CostTerm:
        own, params = wp.func(function), keys.Params

        @wp.func(module="unique")
        def number(s: StepView, p: params, i: int) -> float:
            v = along(s, own(s, p), p.heading)
            return v[p.axis[i]] - wanted(s, p.wanted, i)

        @wp.func(module="unique")
        def cost(s: StepView, p: params) -> float:
            total = wp.float32(0.0)
            v = along(s, own(s, p), p.heading)
            for i in range(p.axis.shape[0]):
                total += norm_part(v[p.axis[i]] - wanted(s, p.wanted, i), p.norm)
            return norm_total(total, p.norm)

        parts = Residual(number, lambda p: p.axis.shape[0])
        return term(name, keys, written=own, residual=parts)(cost)

    return decorate


@wp.func
def along(s: StepView, r: wp.vec3, heading: int) -> wp.vec3:
    """A vector along the axes: ahead, to the left and up where they turn with a heading, the x axis seen from above."""
    if heading < 0:
        return r
    ahead = wp.quat_rotate(frame_rotation(s, heading), wp.vec3(1.0, 0.0, 0.0))
    # a frame that looks straight up has no heading
    scale = 1.0 / wp.max(wp.sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1]), 1.0e-6)
    cosine = scale * ahead[0]
    sine = scale * ahead[1]
    return wp.vec3(cosine * r[0] + sine * r[1], cosine * r[1] - sine * r[0], r[2])


class SpatialResidual(ResidualKeys):
    """A residual along axes of the world, or ahead, to the left and up."""

    of: Place
    """Frame, or { centre_of_mass = "robot" }, or a list of such: their mean."""
    axes: Axes | None = None
    """Axes that count, such as "xy"; all when left out, but for heights of goals that have none."""
    heading: str | None = None
    """Frame whose heading, its x axis seen from above, the axes turn with; they are the world's when left out."""

    derived = SPATIAL

    def bind_places(self, p: Any, lead: float, b: Binding) -> None:
        """Fill the parameters with the difference of two places."""
        points = [point.scaled(1.0, lead) for point in place_points(self.of, "of", b)]
        points += [point.scaled(-1.0) for point in place_points(self.relative_to or (), "relative_to", b)]
        flat = self.without_height(b)
        if self.axes and "z" in self.axes and flat:
            raise b.error("this pose has no height: give it three coordinates, or leave z out", "axes", found=flat[0])
        self.of_axes(p, points, self.axes or ("xy" if flat else "xyz"), b)
        if self.heading:
            p.heading = b.frame(self.heading, "heading")

    def without_height(self, b: Binding) -> list[str]:
        """Goals among the places that have no height."""
        return []


class Position(SpatialResidual):
    """Position of a place [m]."""

    relative_to: Place | None = None
    """Place it is seen from, as ``of``; the world's origin when left out."""
    lead: NonNegative = 0.0
    """Look at where ``of`` would coast to in this time [s]."""

    def bind(self, p: Any, b: Binding) -> None:
        """Find the places."""
        self.bind_places(p, self.lead, b)

    def without_height(self, b: Binding) -> list[str]:
        """Goals among the places that have no height."""
        parts = (*self.of, *(self.relative_to or ()))
        return [part for part in parts if isinstance(part, str) and part in b.scene.flat_poses]


@spatial("position_residual", Position)
def position_residual(s: StepView, p: Position.Params) -> wp.vec3:
    """Norm of a place's position from another one's, less the wanted one [m]."""
    return points_position(s, p.points)


class Velocity(SpatialResidual):
    """Velocity of a place [m/s]."""

    relative_to: Place | None = None
    """Place whose velocity is taken off, as ``of``."""

    def bind(self, p: Any, b: Binding) -> None:
        """Find the places."""
        self.bind_places(p, 0.0, b)


@spatial("velocity_residual", Velocity)
def velocity_residual(s: StepView, p: Velocity.Params) -> wp.vec3:
    """Norm of a place's velocity from another one's, less the wanted one [m/s]."""
    return points_velocity(s, p.points)


class AngularVelocity(ResidualKeys):
    """Angular velocity of a frame [rad/s]."""

    of: Names
    """Frame, or a list of frames: their mean."""
    relative_to: Names | None = None
    """Frame whose angular velocity is taken off, as ``of``."""
    axes: Axes = "xyz"
    """Axes of the world that count."""

    derived = SPATIAL

    def bind(self, p: Any, b: Binding) -> None:
        """Find the frames."""
        points = place_points(self.of, "of", b)
        points += [point.scaled(-1.0) for point in place_points(self.relative_to or (), "relative_to", b)]
        self.of_axes(p, points, self.axes, b)


@spatial("angular_velocity_residual", AngularVelocity)
def angular_velocity_residual(s: StepView, p: AngularVelocity.Params) -> wp.vec3:
    """Norm of a frame's angular velocity from another one's, less the wanted one [rad/s]."""
    return points_angular_velocity(s, p.points)


class Rotation(TermKeys):
    """Rotation between two frames."""

    of: Frame
    """Frame."""
    to: Frame = "goal"
    """Frame it is compared with."""
    axes: Axes = "xyz"
    """Axes of the frames that are compared: "z" leaves turns about it free."""
    norm: NormKey = NormKind.QUADRATIC
    """quadratic, or { kind, p, q }: l2, l22, cosh, power, smooth_abs, smooth_abs2, rectify."""

    derived = {"axis": wp.array[int], "numbers": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Set the axes of the frames that are compared; each has three numbers."""
        p.axis = b.array(["xyz".index(axis) for axis in self.axes], dtype=int)
        p.numbers = 3 * len(self.axes)


@residual("rotation_residual", Rotation)
def rotation_residual(s: StepView, p: Rotation.Params, i: int) -> float:
    """Norm of (R_a - R_b)/√2, whose length is 2 sin(θ/2) of the angle θ between two frames."""
    e = wp.vec3(0.0)
    e[p.axis[i // 3]] = 0.7071067811865476
    d = wp.quat_rotate(frame_rotation(s, p.of), e) - wp.quat_rotate(frame_rotation(s, p.to), e)
    return d[i % 3]


class Momentum(ResidualKeys):
    """Momentum of all that belongs to something."""

    of: str
    """Robot, object, or ``robot/link`` with all that hangs on it."""
    axes: Axes = "xyz"
    """Axes of the world that count."""

    derived = SPATIAL

    def bind(self, p: Any, b: Binding) -> None:
        """Find the bodies, whose shares are their masses [kg]."""
        bodies = massive(self.of, "of", b)
        com, mass = b.layout.body_com[bodies].tolist(), b.layout.body_mass[bodies].tolist()
        points = [Point(int(body), tuple(at), m) for body, at, m in zip(bodies, com, mass, strict=True)]
        self.of_axes(p, points, self.axes, b)


@spatial("momentum_residual", Momentum)
def momentum_residual(s: StepView, p: Momentum.Params) -> wp.vec3:
    """Norm of the linear momentum, less the wanted one [kg m/s]."""
    return points_velocity(s, p.points)


class AngularMomentum(Momentum):
    """Angular momentum of all that belongs to something."""

    derived = SPATIAL | {
        "mass": wp.array[float],  # [n] of each of its bodies [kg]
        "inertia": wp.array[wp.mat33],  # [n] about its centre of mass, along the body's axes [kg m²]
    }

    def bind(self, p: Any, b: Binding) -> None:
        """Find the bodies and their centre of mass."""
        bodies = massive(self.of, "of", b)
        self.of_axes(p, place_points((CentreOfMass(centre_of_mass=self.of),), "of", b), self.axes, b)
        p.mass = b.array(b.layout.body_mass[bodies], dtype=float)
        p.inertia = b.array(b.layout.body_inertia[bodies], dtype=wp.mat33)


@spatial("angular_momentum_residual", AngularMomentum)
def angular_momentum_residual(s: StepView, p: AngularMomentum.Params) -> wp.vec3:
    """Norm of the angular momentum about the centre of mass, less the wanted one [kg m²/s].

    That is Σ I ω + m (x - c) × (v - ċ) over the bodies.
    """
    centre = points_position(s, p.points)
    moving = points_velocity(s, p.points)
    total = wp.vec3(0.0)
    for i in range(p.mass.shape[0]):
        body = p.points.body[i]
        pose = s.body_q[s.t, s.w, body]
        twist = s.body_qd[s.t, s.w, body]
        turn = wp.transform_get_rotation(pose)
        x = wp.transform_point(pose, p.points.at[i])
        spin = wp.quat_rotate_inv(turn, wp.spatial_bottom(twist))
        total += wp.quat_rotate(turn, p.inertia[i] * spin)
        total += p.mass[i] * wp.cross(x - centre, wp.spatial_top(twist) - moving)
    return total
