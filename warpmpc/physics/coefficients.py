# SPDX-License-Identifier: Apache-2.0
"""Softness of a row of constraint.

Coefficients of springs and dampers, which may grow with their travel and speed (MuJoCo, "Passive forces").

Limits of joints, tendons, controls and forces, of which files may say that there are none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

    from .runtime.bake import Lines, Operand

LEAST_IMPEDANCE, MOST_IMPEDANCE = 1e-4, 0.9999
"""Bounds of an impedance (MuJoCo, "Solver parameters")."""
LEAST = 1e-15
"""What MuJoCo takes for zero (``mjMINVAL``)."""
REFERENCE = (0.02, 1.0)
"""Time constant [s] and damping ratio where nothing is said."""


def mixed(solref: np.ndarray) -> bool:
    """Return whether one number of a reference is positive and the other is not: neither of its two formats."""
    return bool((solref[0] > 0.0) != (solref[1] > 0.0))


@dataclass(frozen=True)
class Rows:
    """Soft constraint parameters of one limit or pair (MuJoCo, "Solver parameters")."""

    stiffness: float
    damping: float
    impedance: tuple[float, float, float, float]
    """Least, most, width and midpoint."""
    power: float = 2.0
    """Of the distance over the width, on both sides of the midpoint."""

    @property
    def slipping(self) -> Rows:
        """The same for friction, which has no place to come back to."""
        return replace(self, stiffness=0.0)

    @classmethod
    def of(cls, solref: np.ndarray, solimp: np.ndarray, timestep: float, *, safe: bool) -> Rows:
        """Stiffness and damping from the reference, which no time constant below two steps may have (``refsafe``).

        A reference of mixed format is replaced by the default, an impedance without width is the mean of its bounds.
        """
        least, most, width, middle, power = solimp
        least, most, middle = (float(np.clip(x, LEAST_IMPEDANCE, MOST_IMPEDANCE)) for x in (least, most, middle))
        if mixed(solref):
            solref = REFERENCE
        if solref[0] > 0.0:
            constant = max(solref[0], 2.0 * timestep) if safe else solref[0]
            stiffness, damping = 1.0 / (most * constant * solref[1]) ** 2, 2.0 / (most * constant)
        else:
            stiffness, damping = -solref[0] / most**2, -solref[1] / most
        if width <= LEAST:
            least = most = 0.5 * (least + most)
        shape = least, most, max(float(width), LEAST), middle
        return cls(float(stiffness), float(damping), shape, max(1.0, float(power)))

    @property
    def least_share(self) -> float:
        """Least regularization over the inverse inertia."""
        most = max(self.impedance[:2])
        return (1.0 - most) / most

    @property
    def powered(self) -> tuple[float, ...]:
        """Impedance with its power, and the factors of both pieces."""
        _, _, _, middle = self.impedance
        low, high = (x ** (1.0 - self.power) for x in (middle, 1.0 - middle))
        return *self.impedance, self.power, low, high


def powers(m: mujoco.MjModel, name: str) -> np.ndarray:
    """Coefficients of a field by powers of travel or speed ``[n, 1 + npoly]``."""
    return np.column_stack([getattr(m, name), getattr(m, f"{name}poly")])


def coefficient(lines: Lines, numbers: np.ndarray, x: str, *, damper: bool) -> tuple[Operand, Operand]:
    """Force over travel or speed, and its slope; that of dampers depends on the speed's size alone."""
    first, *more = (float(number) for number in numbers)
    if not any(more):
        return first, first
    size = lines.let(f"VABS({x})") if damper else x
    value: Operand = 0.0
    slope: Operand = 0.0
    for power in range(len(more), 0, -1):
        value = lines.sum((size, lines.sum(more[power - 1], value)))
        slope = lines.sum((size, lines.sum((power + 1.0) * more[power - 1], slope)))
    return lines.sum(first, value), lines.sum(first, slope)


def negative(lines: Lines, value: Operand) -> Operand:
    """A value with the other sign."""
    return -value if isinstance(value, float) else lines.sum((-1.0, value))


UNBOUNDED = 1e30
"""Limits from here on are none: files say infinity, or a number as large as they can."""

UNLIMITED = np.array([-UNBOUNDED, UNBOUNDED])


def within(limits: np.ndarray) -> np.ndarray:
    """Limits as numbers that single precision holds."""
    return np.clip(limits, -UNBOUNDED, UNBOUNDED)


def narrow(limits: np.ndarray, margin: float) -> bool:
    """Return whether both limits may hold at once: they are nearer than twice their margin."""
    return bool(np.ptp(within(limits)) < 2.0 * margin)


def bounds(limits: np.ndarray) -> bool:
    """Return whether a lower and an upper limit leave anything out."""
    return bool((np.abs(limits) < UNBOUNDED).any())
