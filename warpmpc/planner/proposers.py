# SPDX-License-Identifier: Apache-2.0
"""Samples that are not drawn: null particles, the best samples so far, sequences of a file, proposals of the host."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..launch import Launcher

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ..model.state import State
    from .report import PlanReport


class Proposer:
    """One or more samples of every plan that are not drawn; they are clamped to the limits when they are tried.

    A proposer on the device writes :attr:`knots` in :meth:`before_plan`. One on the host is asked before that; its
    answer travels with the observation (:class:`~.ancillary.Ancillaries`, :class:`LaunchedSamples`).

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
            state: Its observed state; None where there is none, and nothing is proposed.
            last: What came of the plan before this one, if there was one since the last reset.
        """

    def reset(self) -> None:
        """Forget earlier plans."""


class LaunchedSamples(Proposer):
    """Samples that one kernel writes for the state that is observed now, a thread for each knot.

    Args:
        kernel: ``null_rows_kernel``, for null particles (the observed position, or what holds the start), or
            ``proposed_rows_kernel``, for answers of the host's proposers, null particles where there is none.
        inputs: Its inputs.
    """

    def __init__(self, count: int, kernel: wp.Kernel, inputs: Sequence[wp.array]):
        super().__init__(count)
        self._kernel, self._inputs, self._launch = kernel, list(inputs), Launcher(inputs[0].device)

    def before_plan(self) -> None:
        """Launch the kernel; capture-safe."""
        self._launch(self._kernel, self.knots.shape[:3], self._inputs, [self.knots])


class BestSamples(Proposer):
    """The best samples so far, which move on with the plan, the best one first.

    Args:
        carry: Lets knots ``[E, P, nu]`` move on with the plan.
    """

    def __init__(self, carry: Callable[[wp.array], None], count: int):
        super().__init__(count)
        self._carry = carry

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots to write, which move on with the plan from now on."""
        super().bind(knots)
        for row in range(len(knots)):
            self._carry(knots[row])


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
