# SPDX-License-Identifier: Apache-2.0
"""Terms of an arm (Bhardwaj et al., STORM, CoRL 2021)."""

from enum import StrEnum
from typing import Any

import numpy as np
import warp as wp

from ...kernels.cost.view import (
    StepView,
    frame_angular_velocity,
    frame_pose,
    frame_position,
    frame_start,
    frame_velocity,
    joint_position,
)
from ...kernels.geometry.jacobian import Chain, jacobian_column, manipulability_of, solve_damped
from ...scene.model.joints import chain, chain_axes
from ...scene.types import Floats, NonNegative, NonNegatives, Positive
from ..binding import Binding
from ..code import state as source
from ..keys import Frame, TermKeys, term
from .joints import JointNames, outside


class Pose(TermKeys):
    """Error of a frame's pose."""

    of: Frame
    """Frame."""
    to: Frame = "goal"
    """Frame it is compared with."""
    position: NonNegatives = (1.0,)
    """Weight of the distance [1/m], one or one for each axis of the second frame; 0 holds the orientation alone."""
    rotation: NonNegatives = (1.0,)
    """Weight of the orientation, one or one for each axis of the second frame: of how far that axis is off."""

    derived = {"position": wp.vec3, "rotation": wp.vec3, "planar": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Spread the weights; a second frame without height leaves heights out."""
        p.planar = int(self.to in b.scene.flat_poses)
        p.position, p.rotation = (wp.vec3(*b.spread(getattr(self, key), 3, key)) for key in ("position", "rotation"))


@term("pose", Pose)
def pose(s: StepView, p: Pose.Params) -> float:
    """Error of a pose, Σ r_i ‖row i of I - R_gᵀR‖ + ‖p_w ⊙ R_gᵀ(p - p_g)‖ (STORM), axes and directions weighted apart.

    Row i is by how much axis i of the goal g, seen from the frame, misses its place: 2 sin(θ/2) for an angle θ.
    """
    a = frame_pose(s, p.of)
    g = frame_pose(s, p.to)
    turn = wp.transform_get_rotation(g)
    d = wp.transform_get_translation(a) - wp.transform_get_translation(g)
    if p.planar != 0:
        d[2] = 0.0
    total = wp.length(wp.cw_mul(p.position, wp.quat_rotate_inv(turn, d)))
    # row i of I - R_gᵀR is as long as R e_i - R_g e_i
    miss = wp.quat_to_matrix(wp.transform_get_rotation(a)) - wp.quat_to_matrix(turn)
    for i in range(3):
        total += p.rotation[i] * wp.length(wp.vec3(miss[0, i], miss[1, i], miss[2, i]))
    return total


class PathDeviation(TermKeys):
    """Distance of a frame from a straight line."""

    of: Frame
    """Frame."""
    to: Frame = "goal"
    """Frame at the end of the line."""
    start: str | None = None
    """Frame at its beginning; where the first frame was when the rollout began if left out."""

    derived = {"start": int, "planar": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the start, -1 for where the frame itself begins; an end without height leaves heights out."""
        p.start = -1 if self.start is None else b.frame(self.start, "start")
        p.planar = int(bool(b.scene.flat_poses & {self.to, self.start}))


@term("path_deviation", PathDeviation)
def path_deviation(s: StepView, p: PathDeviation.Params) -> float:
    """Distance of a frame from the straight line between two places [m]: ‖p - (a + λ (b - a))‖, least in λ ∈ [0, 1].

    The line ends at frame b and begins at frame a, or where the frame itself was when the rollout began.
    """
    at = frame_position(s, p.of)
    a = wp.vec3(0.0)
    if p.start >= 0:
        a = frame_position(s, p.start)
    else:
        a = frame_start(s, p.of)
    way = frame_position(s, p.to) - a
    gone = at - a
    if p.planar != 0:
        gone[2] = 0.0
        way[2] = 0.0
    share = wp.clamp(wp.dot(gone, way) / wp.max(wp.length_sq(way), 1.0e-12), 0.0, 1.0)
    return wp.length(gone - share * way)


class Speed(TermKeys):
    """Speed of a frame above a limit."""

    of: Frame
    """Frame."""
    linear: NonNegative | None = None
    """Speed of its origin that costs nothing [m/s]; any when left out."""
    angular: NonNegative | None = None
    """Speed of turning that costs nothing [rad/s]; any when left out."""

    derived = {"linear": float, "angular": float}

    def bind(self, p: Any, b: Binding) -> None:
        """Set the limits; infinite where there are none."""
        if self.linear is None and self.angular is None:
            raise b.error("needs linear, angular, or both")
        p.linear, p.angular = (np.inf if limit is None else limit for limit in (self.linear, self.angular))


@term("speed", Speed)
def speed(s: StepView, p: Speed.Params) -> float:
    """Speed of a frame above a limit, max(0, ‖v‖ - v_max)² + max(0, ‖ω‖ - ω_max)² [m²/s², rad²/s²]."""
    linear = outside(wp.length(frame_velocity(s, p.of)), p.linear)
    return linear + outside(wp.length(frame_angular_velocity(s, p.of)), p.angular)


class FrameChain(TermKeys):
    """The joints that move a frame."""

    of: Frame
    """Frame of a robot."""
    joints: JointNames | None = None
    """Joints that count of those that move the frame, ``robot/joint`` or the joint's own name; all when left out."""

    def bind_chain(self, b: Binding) -> tuple[Chain, list[int]]:
        """The joints that move a frame, and the degrees of freedom that are columns of its Jacobian.

        Raises:
            SceneError: If nothing moves the frame, or a ball joint does, or a joint that is named does not.
        """
        layout = b.layout
        body = int(layout.frame_body[b.frame(self.of, "of")])
        try:
            axes = chain_axes(layout, body)[::-1]
        except ValueError as error:
            raise b.error(
                "a ball joint moves this frame; it does not turn about fixed axes", "of", found=str(error)
            ) from None
        if not axes:
            raise b.error("no joint moves this frame", "of", found=self.of)
        if self.joints is None:
            return chain(layout, body, axes, b.device), axes
        by_coord = {int(layout.dof_coord[dof]): dof for dof in axes}
        coords = [b.joint(name, "joints") for name in self.joints]
        for name, coord in zip(self.joints, coords, strict=True):
            if coord not in by_coord:
                own = [layout.dof_name[dof] for dof in axes]
                raise b.error("this joint does not move the frame", "joints", found=name, allowed=own)
        if len(set(coords)) < len(coords):
            raise b.error("a joint is named twice", "joints", found=list(self.joints))
        columns = [by_coord[coord] for coord in coords]
        return chain(layout, body, columns, b.device), columns


class Form(StrEnum):
    """Form of the cost of manipulability below its least value."""

    RAMP = "ramp"
    STEP = "step"


class Manipulability(FrameChain):
    """Nearness of a frame to a posture from which it cannot move every way."""

    least: Positive = 0.03
    """Manipulability k_m from which on nothing is to pay; a Panda's is up to about 0.1."""
    form: Form = Form.RAMP
    """ramp: (k_m - m)/k_m, from 0 to 1; step: 1 - m."""

    derived = {"chain": Chain, "step": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the joints that move the frame."""
        p.chain, _ = self.bind_chain(b)
        p.step = int(self.form is Form.STEP)


@term("manipulability", Manipulability, source=source.manipulability)
def manipulability(s: StepView, p: Manipulability.Params) -> float:
    """Lack of manipulability m = √det(J Jᵀ), max(0, (k_m - m)/k_m) (STORM's code), or 1 - m where m < k_m.

    The latter is the paper's form (Eq. 10). Chains of fewer than six joint axes have √det(Jᵀ J).
    """
    m = manipulability_of(p.chain, frame_position(s, p.of), s.joint_q, s.body_q, s.t, s.w)
    if p.step != 0:
        return wp.where(m < p.least, 1.0 - m, 0.0)
    return wp.max((p.least - m) / p.least, 0.0)


class NullPosture(FrameChain):
    """Distance to a posture, as far as the frame's pose leaves it free."""

    target: Floats | None = None
    """Wanted posture [m or rad], by joint from the root on or as in ``joints``; the scene's start when left out."""
    damping: Positive = 0.01
    """Singular value of the Jacobian at which a direction belongs half to the null space."""

    derived = {"chain": Chain, "target": wp.array[float], "damping": float}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the joints that move the frame and their wanted posture [m or rad]."""
        p.chain, dofs = self.bind_chain(b)
        p.damping = self.damping * self.damping
        target = b.layout.joint_q[b.layout.dof_coord[dofs]] if self.target is None else np.array(self.target)
        if len(target) != len(dofs):
            names = ", ".join(b.layout.dof_name[dof] for dof in dofs)
            raise b.error(f"needs one value per joint, {len(dofs)} in all ({names})", "target", found=list(self.target))
        p.target = b.array(target, dtype=float)


@term("null_posture", NullPosture)
def null_posture(s: StepView, p: NullPosture.Params) -> float:
    """Distance from the posture q₀ in the null space of a frame's pose, ‖(I - J⁺J)(q - q₀)‖² [rad² or m²].

    STORM's null-space term, which its code leaves unprojected as ``posture`` does. J⁺ = Jᵀ(J Jᵀ + λ²I)⁻¹, damped, so
    that near a singular posture the direction that is lost goes over to the null space gradually.
    """
    at = frame_position(s, p.of)
    n = p.chain.column.shape[0]
    gram = wp.spatial_matrix(0.0)
    moved = wp.spatial_vector()
    for i in range(n):
        column = jacobian_column(p.chain, i, at, s.joint_q, s.body_q, s.t, s.w)
        gram += wp.outer(column, column)
        moved += column * (joint_position(s, p.chain.coord[p.chain.column[i]]) - p.target[i])
    x = solve_damped(gram, p.damping, moved)
    total = wp.float32(0.0)
    for i in range(n):
        column = jacobian_column(p.chain, i, at, s.joint_q, s.body_q, s.t, s.w)
        d = joint_position(s, p.chain.coord[p.chain.column[i]]) - p.target[i] - wp.dot(column, x)
        total += d * d
    return total
