# SPDX-License-Identifier: Apache-2.0
"""Samples that are not drawn: null particles, the best samples so far, sequences of a file, proposals of the host."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.planning.proposals import null_rows_kernel, proposed_rows_kernel
from ..launch import Launcher

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ..model.state import State
    from .report import PlanReport


class Proposer:
    """One or more samples of every plan that are not drawn; they are clamped to the limits when they are tried.

    A proposer on the device writes :attr:`knots` in :meth:`before_plan`. One on the host is asked before that; its
    answer travels with the observation (:class:`~.ancillary.Ancillaries`, :class:`AskedSamples`).

    Args:
        count: Number of samples.
    """

    knots: wp.array4d[float]
    """Knots ``[count, E, P, nu]``, on the device."""

    def __init__(self, count: int):
        self.count = count

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots to write."""
        self.knots = knots

    def before_plan(self) -> None:
        """Write the knots for the state that is observed now, once the plan has moved on; capture-safe."""

    def ask(
        self, e: int, state: State | None, task: Mapping[str, np.ndarray | float], last: PlanReport
    ) -> np.ndarray | None:
        """Knots ``[n, P, nu]`` for one environment, n at most :attr:`count`; not finite, or None, for a null particle.

        Args:
            e: Environment.
            state: Its observed state; None where there is none, and nothing is proposed.
            task: What the run wants there.
            last: What came of the plan before this one, if there was one since the last reset.
        """

    def reset(self) -> None:
        """Forget earlier plans."""


class NullSamples(Proposer):
    """Null particles, which ask for nothing all along: no speed or effort, or the observed position held.

    Args:
        count: Number of samples.
        null: Controls that ask for nothing in the observed state ``[E, nu]``.
    """

    def __init__(self, count: int, null: wp.array):
        super().__init__(count)
        self._null, self._launch = null, Launcher(null.device)

    def before_plan(self) -> None:
        """Write what asks for nothing now; capture-safe."""
        self._launch(null_rows_kernel, self.knots.shape[:3], [self._null], [self.knots])


class BestSamples(Proposer):
    """The best samples so far, which move on with the plan, the best one first.

    Args:
        carry: Lets knots ``[E, P, nu]`` move on with the plan.
        count: Number of samples.
    """

    def __init__(self, carry: Callable[[wp.array], None], count: int):
        super().__init__(count)
        self._carry = carry

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots to write, which move on with the plan from now on."""
        super().bind(knots)
        for row in range(len(knots)):
            self._carry(knots[row])


class AskedSamples(Proposer):
    """Answers of the host's proposers for the observed state; where that is nothing, a null particle.

    Args:
        proposed: Knots of all of them, side by side ``[E, n·P·nu]``.
        null: Controls that ask for nothing in the observed state ``[E, nu]``.
        columns: Numbers of a plan, P·nu.
    """

    def __init__(self, proposed: wp.array, null: wp.array, columns: int):
        super().__init__(proposed.shape[1] // columns)
        self._proposed, self._null, self._launch = proposed, null, Launcher(null.device)

    def before_plan(self) -> None:
        """Write what is proposed now; capture-safe."""
        self._launch(proposed_rows_kernel, self.knots.shape[:3], [self._proposed, self._null], [self.knots])


class StoredSamples(Proposer):
    """Sequences of a file, the same at every plan.

    Args:
        sequences: Their knots ``[n, P, nu]``.
    """

    def __init__(self, sequences: np.ndarray):
        super().__init__(len(sequences))
        self._sequences = sequences

    def bind(self, knots: wp.array4d[float]) -> None:
        """Fill the knots, once and for all."""
        super().bind(knots)
        knots.assign(np.broadcast_to(self._sequences[:, None], knots.shape).astype(np.float32))
