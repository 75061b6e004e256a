# SPDX-License-Identifier: Apache-2.0
"""Numbers that come back from the device after a plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PlanReport:
    """Outcome of a plan; views of the block that was copied back, overwritten by the next plan."""

    command: np.ndarray  # [E, nu]
    beta: np.ndarray  # [E]
    eta: np.ndarray  # [E]
    cost: np.ndarray  # [E] of the best sample, +inf when every sample diverged
    best: np.ndarray  # [E] sample
    diverged: np.ndarray  # [E] worlds whose physics failed
    overflow_halves: np.ndarray  # [2, E] capacity bits of all worlds together, the lower 16 first
    terms: np.ndarray  # [E, terms] of the best sample
    knots: np.ndarray  # [E, P, nu] of the plan
    offset: np.ndarray  # [E] time from the first knot to the present [s]

    @property
    def overflow(self) -> np.ndarray:
        """Capacity bits of all worlds together ``[E]``."""
        low, high = self.overflow_halves.astype(np.int64)
        return low | high << 16
