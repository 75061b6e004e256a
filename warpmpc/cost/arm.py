# SPDX-License-Identifier: Apache-2.0
"""The cost terms of an arm: how their keys in scene files become kernel parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.terms import arm as costs
from ..model.joints import chain, chain_axes, driving
from ..scene.errors import SceneError
from .arm_keys import (
    Form,
    FrameChain,
    JointBounds,
    Manipulability,
    NullPosture,
    PathDeviation,
    Pose,
    Smoothness,
    Speed,
    Stop,
)
from .joints import joint_dofs
from .native import arm as native
from .term import CostTerm, parse_keys

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..kernels.geometry.jacobian import Chain
    from .binding import Binding
    from .keys import Joints

_NO_LIMIT = 1e6
"""What is this or more in an asset's limits is no limit."""


def _spread(values: Sequence[float], count: int, key: str, b: Binding) -> np.ndarray:
    """One value for each of some joints or axes, from one for all or a list.

    Raises:
        SceneError: If the list has another length.
    """
    if len(values) not in (1, count):
        raise SceneError(f"needs 1 or {count} values", key=f"{b.key}.{key}", file=b.file, found=list(values))
    return np.broadcast_to(np.array(values, dtype=np.float32), count)


def _pose(keys: dict[str, Any], b: Binding) -> costs.PoseParams:
    v = parse_keys(Pose, keys, b)
    p = costs.PoseParams()
    p.of, p.to, p.planar = b.frame(v.of, "of"), b.frame(v.to, "to"), int(v.to in b.scene.flat_poses)
    p.position, p.rotation = (wp.vec3(*_spread(getattr(v, key), 3, key, b)) for key in ("position", "rotation"))
    return p


def _axes(v: Joints, b: Binding) -> np.ndarray:
    """Degrees of freedom of joints that slide or turn about axes of their own, the only ones with a coordinate each."""
    dofs = np.array(joint_dofs(v, b), dtype=int)
    return dofs[b.layout.dof_coord[dofs] >= 0]


def _stop(keys: dict[str, Any], b: Binding) -> costs.StopParams:
    v = parse_keys(Stop, keys, b)
    dofs = _axes(v, b)
    if v.acceleration is not None:
        limit = _spread(v.acceleration, len(dofs), "acceleration", b)
    else:
        driven = driving(b.layout, dofs, "acceleration")
        if v.joints is None:
            dofs, driven = dofs[driven >= 0], driven[driven >= 0]
        if not len(dofs) or (driven < 0).any():
            raise SceneError(
                "no drive of these joints takes accelerations: give the greatest one",
                key=f"{b.key}.acceleration",
                file=b.file,
                found=[b.layout.dof_name[dof] for dof in dofs[driven < 0]] or None,
            )
        # what it can brake with, whichever way it goes
        limit = np.minimum(-b.layout.control_lower[driven], b.layout.control_upper[driven])
    p = costs.StopParams()
    p.joint = b.array(dofs, dtype=int)
    p.acceleration = b.array(limit, dtype=float)
    return p


def _chain(v: FrameChain, b: Binding) -> tuple[Chain, list[int]]:
    """The joints that move a frame, and the degrees of freedom that are columns of its Jacobian.

    Raises:
        SceneError: If nothing moves the frame, or a ball joint does, or a joint that is named does not.
    """
    layout, where = b.layout, f"{b.key}.joints"
    body = int(layout.frame_body[b.frame(v.of, "of")])
    try:
        axes = chain_axes(layout, body)[::-1]
    except ValueError as error:
        raise SceneError(
            "a ball joint moves this frame, whose turns are not about axes of its own",
            key=f"{b.key}.of",
            file=b.file,
            found=str(error),
        ) from None
    if not axes:
        raise SceneError("no joint moves this frame", key=f"{b.key}.of", file=b.file, found=v.of)
    if v.joints is None:
        return chain(layout, body, axes, b.device), axes
    by_coord = {int(layout.dof_coord[dof]): dof for dof in axes}
    coords = [b.joint(name, "joints") for name in v.joints]
    for name, coord in zip(v.joints, coords, strict=True):
        if coord not in by_coord:
            own = [layout.dof_name[dof] for dof in axes]
            raise SceneError("this joint does not move the frame", key=where, file=b.file, found=name, allowed=own)
    if len(set(coords)) < len(coords):
        raise SceneError("a joint is named twice", key=where, file=b.file, found=list(v.joints))
    columns = [by_coord[coord] for coord in coords]
    return chain(layout, body, columns, b.device), columns


def _manipulability(keys: dict[str, Any], b: Binding) -> costs.ManipulabilityParams:
    v = parse_keys(Manipulability, keys, b)
    p = costs.ManipulabilityParams()
    p.of, p.least, p.step = b.frame(v.of, "of"), v.least, int(v.form is Form.STEP)
    p.chain, _ = _chain(v, b)
    return p


def _joint_bounds(keys: dict[str, Any], b: Binding) -> costs.JointBoundsParams:
    v = parse_keys(JointBounds, keys, b)
    layout, dofs = b.layout, _axes(v, b)
    lower, upper = (a[dofs].astype(np.float64) for a in (layout.dof_lower, layout.dof_upper))
    limited = upper - lower < _NO_LIMIT
    left = 1.0 - v.margin

    def shrunk(key: str, default: np.ndarray) -> wp.array:
        given = getattr(v, key)
        values = default if given is None else _spread(given, len(dofs), key, b)
        return b.array(np.where(values < _NO_LIMIT, left * values, np.inf), dtype=float)

    p = costs.JointBoundsParams()
    p.joint, p.coord = b.array(dofs, dtype=int), b.array(layout.dof_coord[dofs], dtype=int)
    p.driven = b.array(driving(layout, dofs, "acceleration"), dtype=int)
    p.middle = b.array(np.where(limited, 0.5 * (lower + upper), 0.0), dtype=float)
    p.reach = b.array(np.where(limited, 0.5 * left * (upper - lower), np.inf), dtype=float)
    none = np.full(len(dofs), np.inf)
    p.velocity = shrunk("velocity", layout.dof_speed[dofs])
    p.acceleration, p.jerk = shrunk("acceleration", none), shrunk("jerk", none)
    return p


def _null_posture(keys: dict[str, Any], b: Binding) -> costs.NullPostureParams:
    v = parse_keys(NullPosture, keys, b)
    p = costs.NullPostureParams()
    p.of, p.damping = b.frame(v.of, "of"), v.damping * v.damping
    p.chain, dofs = _chain(v, b)
    target = b.layout.joint_q[b.layout.dof_coord[dofs]]
    if v.target is not None:
        if len(v.target) != len(dofs):
            names = ", ".join(b.layout.dof_name[dof] for dof in dofs)
            raise SceneError(
                f"needs one value per joint, {len(dofs)} in all ({names})",
                key=f"{b.key}.target",
                file=b.file,
                found=list(v.target),
            )
        target = np.array(v.target)
    p.target = b.array(target, dtype=float)
    return p


def _path_deviation(keys: dict[str, Any], b: Binding) -> costs.PathDeviationParams:
    v = parse_keys(PathDeviation, keys, b)
    p = costs.PathDeviationParams()
    p.of, p.to = b.frame(v.of, "of"), b.frame(v.to, "to")
    p.start = -1 if v.start is None else b.frame(v.start, "start")
    p.planar = int(bool(b.scene.flat_poses & {v.to, v.start}))
    return p


def _speed(keys: dict[str, Any], b: Binding) -> costs.SpeedParams:
    v = parse_keys(Speed, keys, b)
    if v.linear is None and v.angular is None:
        raise SceneError("needs linear, angular, or both", key=b.key, file=b.file)
    p = costs.SpeedParams()
    p.of = b.frame(v.of, "of")
    p.linear, p.angular = (np.inf if limit is None else limit for limit in (v.linear, v.angular))
    return p


def _smoothness(keys: dict[str, Any], b: Binding) -> costs.SmoothnessParams:
    v = parse_keys(Smoothness, keys, b)
    dofs = _axes(v, b)
    p = costs.SmoothnessParams()
    p.joint = b.array(dofs, dtype=int)
    p.driven = b.array(driving(b.layout, dofs, "acceleration"), dtype=int)
    p.acceleration, p.jerk = v.acceleration, v.jerk
    return p


TERMS = (
    CostTerm("pose", costs.pose, costs.PoseParams, _pose, Pose),
    CostTerm("stop", costs.stop, costs.StopParams, _stop, Stop),
    CostTerm(
        "manipulability",
        costs.manipulability,
        costs.ManipulabilityParams,
        _manipulability,
        Manipulability,
        native.manipulability,
    ),
    CostTerm(
        "joint_bounds",
        costs.joint_bounds,
        costs.JointBoundsParams,
        _joint_bounds,
        JointBounds,
    ),
    CostTerm(
        "null_posture",
        costs.null_posture,
        costs.NullPostureParams,
        _null_posture,
        NullPosture,
    ),
    CostTerm(
        "path_deviation",
        costs.path_deviation,
        costs.PathDeviationParams,
        _path_deviation,
        PathDeviation,
    ),
    CostTerm("speed", costs.speed, costs.SpeedParams, _speed, Speed),
    CostTerm("smoothness", costs.smoothness, costs.SmoothnessParams, _smoothness, Smoothness),
)
"""Terms of an arm."""
