# SPDX-License-Identifier: Apache-2.0
"""Samples that are not drawn, side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import warp as wp

if TYPE_CHECKING:
    from collections.abc import Sequence


class FixedRow(Protocol):
    """One or more samples that are not drawn; they are clamped to the limits when they are proposed."""

    count: int
    """Number of samples."""

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots ``[count, E, P, nu]`` to write."""

    def before_plan(self) -> None:
        """Write them for the state that is observed now, once the plan has moved on; capture-safe."""


class FixedRows:
    """All fixed rows, samples 1 to F of every environment; sample 0 is the mean where that is tried.

    Args:
        rows: What they are, in order.
        dim: Environments, knots and controls ``(E, P, nu)``.
        device: Warp device.
    """

    knots: wp.array4d[float]
    """Their knots ``[F, E, P, nu]``, each row in one piece; one row of zeros where there are none."""

    def __init__(self, rows: Sequence[FixedRow], dim: tuple[int, int, int], device: str):
        self._rows = [row for row in rows if row.count]
        self.count = sum(row.count for row in self._rows)
        shape = (max(self.count, 1), *dim)
        self.knots = wp.zeros(shape, dtype=float, device=device)
        first = 0
        for row in self._rows:
            row.bind(self.knots[first : first + row.count])
            first += row.count

    def before_plan(self) -> None:
        """Write them for the state that is observed now; capture-safe."""
        for row in self._rows:
            row.before_plan()
