# SPDX-License-Identifier: Apache-2.0
"""Residuals that are numbers of one kind: of joints, controls, actuators, sensors and contacts."""

import warp as wp

from .norms import Norm, norm_part, norm_total
from .residuals import Wanted, wanted
from .view import StepView, contact_force, control, joint_position, joint_velocity, sensor

wp.set_module_options({"enable_backward": False})

JOINT_POSITION = wp.constant(0)
JOINT_VELOCITY = wp.constant(1)
CONTROL = wp.constant(2)
SENSOR = wp.constant(3)
CONTACT = wp.constant(4)
CONTACT_FORCE = wp.constant(5)


@wp.struct
class NumbersParams:
    """Parameters of residuals that are numbers of one kind."""

    kind: int
    index: wp.array[int]  # [n] which: coordinate, velocity, control, number of a sensor; 3 pair + axis of forces
    least: float  # [N] force from which on there is contact
    wanted: Wanted
    norm: Norm


@wp.func
def number(s: StepView, p: NumbersParams, i: int) -> float:
    """Number i as it is."""
    at = p.index[i]
    if p.kind == JOINT_POSITION:
        return joint_position(s, at)
    if p.kind == JOINT_VELOCITY:
        return joint_velocity(s, at)
    if p.kind == CONTROL:
        return control(s, at)
    if p.kind == SENSOR:
        return sensor(s, at)
    if p.kind == CONTACT:
        return wp.where(wp.length(contact_force(s, at)) > p.least, 1.0, 0.0)
    return contact_force(s, at // 3)[at % 3]


@wp.func
def numbers_component(s: StepView, p: NumbersParams, i: int) -> float:
    """Number i of the residual."""
    return number(s, p, i) - wanted(s, p.wanted, i)


@wp.func
def numbers_cost(s: StepView, p: NumbersParams) -> float:
    """Norm of the numbers, less what is wanted."""
    total = float(0.0)
    for i in range(p.index.shape[0]):
        total += norm_part(numbers_component(s, p, i), p.norm)
    return norm_total(total, p.norm)


@wp.func
def posture_residual(s: StepView, p: NumbersParams) -> float:
    """Norm of joint positions less the wanted ones [m or rad]."""
    return numbers_cost(s, p)


@wp.func
def joint_velocity_residual(s: StepView, p: NumbersParams) -> float:
    """Norm of joint velocities less the wanted ones [m/s or rad/s]."""
    return numbers_cost(s, p)


@wp.func
def control_residual(s: StepView, p: NumbersParams) -> float:
    """Norm of controls less the wanted ones, in their own units."""
    return numbers_cost(s, p)


@wp.func
def sensor_residual(s: StepView, p: NumbersParams) -> float:
    """Norm of what sensors show less what they shall, in their own units."""
    return numbers_cost(s, p)


@wp.func
def contact_residual(s: StepView, p: NumbersParams) -> float:
    """Norm of which pairs touch, 1 or 0, less which shall."""
    return numbers_cost(s, p)


@wp.func
def contact_force_residual(s: StepView, p: NumbersParams) -> float:
    """Norm of net contact forces less the wanted ones [N]."""
    return numbers_cost(s, p)
