# SPDX-License-Identifier: Apache-2.0
"""Samples that are not drawn: null particles, the best samples so far, sequences of a file, proposals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.planning.proposals import null_rows_kernel, proposed_rows_kernel
from ..launch import Launcher

if TYPE_CHECKING:
    from .distribution import Gaussian


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


class BestRows:
    """The best samples so far, which move on with the plan, the best one first.

    Args:
        distribution: What the plan moves on with.
        count: How many of them are among the samples; without any the best one is kept, but not tried again.
    """

    knots: wp.array4d[float]
    """Their knots ``[max(count, 1), E, P, nu]``."""

    def __init__(self, distribution: Gaussian, count: int):
        self.count, self._distribution = count, distribution
        if not count:
            self.bind(wp.zeros((1, *distribution.dim), dtype=float, device=distribution.device))

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots ``[count, E, P, nu]`` to write."""
        self.knots = knots
        for row in range(len(knots)):
            self._distribution.carry(knots[row])

    def before_plan(self) -> None:
        """Nothing: the distribution has moved it on."""


class ProposedRows:
    """What ancillary controllers propose for the observed state; where that is nothing, a null particle.

    Args:
        proposed: Knots of all of them, side by side ``[E, n·P·nu]``.
        null: Controls that ask for nothing in the observed state ``[E, nu]``.
        columns: Numbers of a plan, P·nu.
    """

    def __init__(self, proposed: wp.array, null: wp.array, columns: int):
        self.count, self._launch = proposed.shape[1] // columns, Launcher(null.device)
        self._proposed, self._null = proposed, null

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots ``[count, E, P, nu]`` to write."""
        self._knots = knots

    def before_plan(self) -> None:
        """Write what is proposed now; capture-safe."""
        self._launch(proposed_rows_kernel, self._knots.shape[:3], [self._proposed, self._null], [self._knots])


class SequenceRows:
    """Sequences of a file, the same at every plan.

    Args:
        sequences: Their knots ``[n, P, nu]``.
    """

    def __init__(self, sequences: np.ndarray):
        self.count, self._sequences = len(sequences), sequences

    def bind(self, knots: wp.array4d[float]) -> None:
        """Fill the knots ``[n, E, P, nu]``, once and for all."""
        knots.assign(np.broadcast_to(self._sequences[:, None], knots.shape).astype(np.float32))

    def before_plan(self) -> None:
        """Nothing: they stay as they are."""
