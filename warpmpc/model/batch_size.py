# SPDX-License-Identifier: Apache-2.0
"""Sizes of a batch of rollouts."""

from dataclasses import dataclass


@dataclass(frozen=True)
class BatchSize:
    """Sizes of a batch of rollouts: E environments × S samples × D domains, T control steps."""

    envs: int
    samples: int
    domains: int
    horizon: int

    @property
    def rollouts(self) -> int:
        """Rollouts per environment, K = S·D."""
        return self.samples * self.domains

    @property
    def worlds(self) -> int:
        """Worlds in all, W = E·S·D; world w = (e·S + s)·D + d."""
        return self.envs * self.rollouts
