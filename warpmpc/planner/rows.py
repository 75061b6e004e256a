# SPDX-License-Identifier: Apache-2.0
"""Samples that are not drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import warp as wp

from ..kernels.planning.proposals import null_rows_kernel
from ..launch import Launcher

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .distribution import Gaussian


class FixedRow(Protocol):
    """One or more samples that are not drawn; they are clamped to the limits when they are proposed."""

    count: int
    """Number of samples."""

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots ``[count, E, P, nu]`` to write."""

    def before_plan(self) -> None:
        """Write them for the state that is observed now, once the plan has moved on; capture-safe."""


class FixedRows:
    """All fixed rows, samples 1 to F of every environment; sample 0 is the mean.

    Args:
        rows: What they are, in order.
        distribution: What the other samples are drawn from.
    """

    knots: wp.array4d[float]
    """Their knots ``[F, E, P, nu]``, each row in one piece; one row of zeros where there are none."""

    def __init__(self, rows: Sequence[FixedRow], distribution: Gaussian):
        self._rows = [row for row in rows if row.count]
        self.count = sum(row.count for row in self._rows)
        shape = (max(self.count, 1), *distribution.dim)
        self.knots = wp.zeros(shape, dtype=float, device=distribution.device)
        first = 0
        for row in self._rows:
            row.bind(self.knots[first : first + row.count])
            first += row.count

    def before_plan(self) -> None:
        """Write them for the state that is observed now; capture-safe."""
        for row in self._rows:
            row.before_plan()


class NullRows:
    """Null particles, which ask for nothing all along: no speed or effort, or the observed position held.

    Args:
        count: Number of samples.
        null: Controls that ask for nothing in the observed state ``[E, nu]``.
    """

    def __init__(self, count: int, null: wp.array):
        self.count, self._null, self._launch = count, null, Launcher(null.device)

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots ``[count, E, P, nu]`` to write."""
        self._knots = knots

    def before_plan(self) -> None:
        """Write what asks for nothing now; capture-safe."""
        self._launch(null_rows_kernel, self._knots.shape[:3], [self._null], [self._knots])
