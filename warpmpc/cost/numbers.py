# SPDX-License-Identifier: Apache-2.0
"""Residual terms that are numbers of joints, controls, sensors and contacts: from keys to kernel parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..kernels.terms import numbers as costs
from ..scene.errors import SceneError
from .joints import joint_dofs, robot_range
from .keys import Joints, Robots
from .residual_keys import Contact, ContactForceNumbers, Controls, JointNumbers, PostureNumbers, Sensors
from .term import CostTerm, Residual, parse_keys
from .wanted import wanted

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import warp as wp

    from ..scene.types import Section
    from .binding import Binding


def _numbers(v: Any, kind: int, index: Sequence[int], b: Binding) -> costs.NumbersParams:
    p = costs.NumbersParams()
    p.kind, p.norm = int(kind), v.norm.struct()
    p.index, p.wanted = b.array(np.array(index, dtype=int), dtype=int), wanted(v.target, len(index), b)
    return p


def _dofs(v: JointNumbers, b: Binding) -> list[int]:
    return joint_dofs(Joints(of=v.of, joints=v.joints), b)


def _posture(keys: dict[str, Any], b: Binding) -> costs.NumbersParams:
    v = parse_keys(PostureNumbers, keys, b)
    coords = b.layout.dof_coord[_dofs(v, b)]
    if v.joints and (coords < 0).any():
        raise SceneError(
            "a joint here has no single coordinate: free and ball joints have rotation_residual and position_residual",
            key=f"{b.key}.joints",
            file=b.file,
            found=list(v.joints),
        )
    coords = coords[coords >= 0]
    if v.target is None:
        v = v.model_copy(update={"target": tuple(b.layout.joint_q[coords].tolist())})
    return _numbers(v, costs.JOINT_POSITION, coords, b)


def _joint_velocity(keys: dict[str, Any], b: Binding) -> costs.NumbersParams:
    v = parse_keys(JointNumbers, keys, b)
    return _numbers(v, costs.JOINT_VELOCITY, _dofs(v, b), b)


def _control(keys: dict[str, Any], b: Binding) -> costs.NumbersParams:
    v = parse_keys(Controls, keys, b)
    if v.controls is None:
        first, count = robot_range(Robots(of=v.of), list(b.layout.control_name), b)
        return _numbers(v, costs.CONTROL, range(first, first + count), b)
    if v.of is not None:
        what = "name controls or their robot, not both: leave out 'of'"
        raise SceneError(what, key=f"{b.key}.controls", file=b.file, found=v.of)
    return _numbers(v, costs.CONTROL, [b.control(name, "controls") for name in v.controls], b)


def _sensor(keys: dict[str, Any], b: Binding) -> costs.NumbersParams:
    v = parse_keys(Sensors, keys, b)
    starts = [b.sensor(name, "sensors") for name in v.sensors]
    sizes = [int(b.layout.sensor_dim[b.layout.sensor_start.tolist().index(start)]) for start in starts]
    index = [start + k for start, size in zip(starts, sizes, strict=True) for k in range(size)]
    return _numbers(v, costs.SENSOR, index, b)


def _contact(keys: dict[str, Any], b: Binding) -> costs.NumbersParams:
    v = parse_keys(Contact, keys, b)
    first, count = b.watch(*v.between, "between")
    p = _numbers(v, costs.CONTACT, range(first, first + count), b)
    p.least = v.least
    return p


def _contact_force(keys: dict[str, Any], b: Binding) -> costs.NumbersParams:
    v = parse_keys(ContactForceNumbers, keys, b)
    first, count = b.watch(*v.between, "between")
    axes = ["xyz".index(axis) for axis in v.axes]
    return _numbers(
        v, costs.CONTACT_FORCE, [3 * pair + axis for pair in range(first, first + count) for axis in axes], b
    )


def _count(p: costs.NumbersParams) -> int:
    return p.index.shape[0]


def _term(function: wp.Function, bind: Callable, keys: type[Section]) -> CostTerm:
    residual = Residual(costs.numbers_component, _count)
    return CostTerm(function.key, function, costs.NumbersParams, bind, keys, residual=residual)


TERMS = (
    _term(costs.posture_residual, _posture, PostureNumbers),
    _term(costs.joint_velocity_residual, _joint_velocity, JointNumbers),
    _term(costs.control_residual, _control, Controls),
    _term(costs.sensor_residual, _sensor, Sensors),
    _term(costs.contact_residual, _contact, Contact),
    _term(costs.contact_force_residual, _contact_force, ContactForceNumbers),
)
"""Residual terms that are numbers of one kind."""
