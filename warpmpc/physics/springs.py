# SPDX-License-Identifier: Apache-2.0
"""Coefficients of springs and dampers, which may grow with their travel and speed (MuJoCo, "Passive forces")."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

    from ..bake.lines import Lines, Operand


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
