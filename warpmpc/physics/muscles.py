# SPDX-License-Identifier: Apache-2.0
"""Arguments of the functions of muscles (``native/muscle.h``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..bake.lines import text

if TYPE_CHECKING:
    from .base import Structure

LEAST = 1e-15


def gain_numbers(model: Structure, actuator: int) -> str:
    """Length at the start of the range, inverse optimum length, and so on, of an active muscle."""
    start, over, first, p, force = _scale(model, actuator, "gain")
    fast = over / np.maximum(LEAST, p[:, 6])
    return _joined(model, start, over, first, p[:, 4], p[:, 5], fast, p[:, 8], force)


def bias_numbers(model: Structure, actuator: int) -> str:
    """The same of a passive one."""
    start, over, first, p, force = _scale(model, actuator, "bias")
    return _joined(model, start, over, first, p[:, 5], p[:, 7] * force)


def _scale(model: Structure, a: int, kind: str) -> tuple[np.ndarray, ...]:
    """Start of the range, inverse optimum length, start over it, all parameters, peak force; ``[W]`` each."""
    p, limits = model.array(f"actuator_{kind}prm")[:, a], model.array("actuator_lengthrange")[:, a]
    force = np.where(p[:, 2] < 0.0, p[:, 3] / np.maximum(LEAST, model.array("actuator_acc0")[:, a]), p[:, 2])
    optimum = (limits[:, 1] - limits[:, 0]) / np.maximum(LEAST, p[:, 1] - p[:, 0])
    return limits[:, 0], 1.0 / np.maximum(LEAST, optimum), p[:, 0], p, force


def _joined(model: Structure, *values: np.ndarray) -> str:
    return ", ".join(text(model.columns.operand(value)) for value in values)
