# SPDX-License-Identifier: Apache-2.0
"""Weightings: from sample costs to sample weights, the part of a strategy in which MPPI, CEM and their kin differ."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar, Protocol

import warp as wp

from ..kernels.planner.weights import (
    best_weight_kernel,
    bisect_temperature_kernel,
    elite_weight_kernel,
    importance_weight_kernel,
    tsallis_weight_kernel,
)
from ..physics.runtime.launch import Launcher

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..scene.schema import Planner


def block_dim(samples: int) -> int:
    """Threads per environment in block-wide kernels on a GPU; Warp takes one on the CPU."""
    return 256 if samples <= 4096 else 1024


class WeightingState:
    """Device arrays a weighting reads and writes; nothing is allocated after construction.

    Args:
        cost: Sample costs, +inf for a diverged sample, ``[E, S]``.
        temperature: Initial temperature β of every environment, in units of cost.
    """

    cost: wp.array2d[float]
    """Sample costs, +inf for a diverged sample, ``[E, S]``."""

    weight: wp.array2d[float]
    """Sample weights, one in sum per environment or all zero when every sample diverged, ``[E, S]``."""

    beta: wp.array[float]
    """Temperature, ``[E]``."""

    eta: wp.array[float]
    """Number of samples that carry weight, ``[E]``."""

    def __init__(self, cost: wp.array2d[float], *, temperature: float = 1.0):
        self.device = cost.device
        self.launch = Launcher(self.device)
        self.temperature, self.cost = temperature, cost
        envs, self.block_dim = cost.shape[0], block_dim(cost.shape[1])
        self.weight = wp.zeros(cost.shape, dtype=float, device=self.device)
        self.beta = wp.full(envs, temperature, dtype=float, device=self.device)
        self.eta = wp.zeros(envs, dtype=float, device=self.device)

    def weigh(self, kernel: wp.Kernel, inputs: Sequence, outputs: Sequence) -> None:
        """Launch a kernel with a block for every environment, whose first input is :attr:`cost`; capture-safe."""
        self.launch(kernel, [self.cost.shape[0]], [self.cost, *inputs], outputs, block_dim=self.block_dim)

    def reset(self) -> None:
        """Return to the initial temperature and to no weights; capture-safe."""
        self.beta.fill_(self.temperature)
        self.weight.zero_()
        self.eta.zero_()


class Weighting(Protocol):
    """Turns the costs of a :class:`WeightingState` into weights."""

    adapts_sigma: ClassVar[bool]
    """True where σ follows the weighted samples unless the scene says otherwise."""

    def launch(self, state: WeightingState) -> None:
        """Write ``state.weight`` and ``state.eta`` from ``state.cost``; capture-safe."""
        ...


class Adaptation(StrEnum):
    """Ways of MPPI to find its temperature; the values are the words of scene files."""

    ETA = "eta"
    """A small step of β towards the bounds of η after each plan step."""

    ESS = "ess"
    """β solved for in the same plan step, so that the effective sample size meets its target."""

    FIXED = "fixed"
    """β stays what it is."""


@dataclass(frozen=True, kw_only=True)
class Mppi:
    """Path-integral weights w = exp(-(S - ρ)/β)/η (Pezzato et al. 2025, Eqs. 3 and 6).

    Args:
        temperature: Initial temperature β, in units of cost.
        adapt: How β is found.
        eta: Lower and upper bound of η that :attr:`Adaptation.ETA` steers towards, in samples.
        target_ess: Effective sample size (Σw)²/Σw² that :attr:`Adaptation.ESS` solves for, in samples.
        beta_bounds: Bounds of an adapted β.
    """

    temperature: float = 1.0
    adapt: Adaptation = Adaptation.ETA
    eta: tuple[float, float] = (5.0, 10.0)
    target_ess: float = 10.0
    beta_bounds: tuple[float, float] = (1.0e-4, 1.0e6)

    adapts_sigma: ClassVar[bool] = False

    @classmethod
    def of(cls, planner: Planner) -> Mppi:
        """The weighting that a scene asks for."""
        t = planner.temperature
        adapt = Adaptation.ESS if t.ess else Adaptation.ETA if t.eta else Adaptation.FIXED
        return cls(temperature=t.initial, adapt=adapt, eta=t.eta or (5.0, 10.0), target_ess=t.ess or 10.0)

    def __post_init__(self):
        Adaptation(self.adapt)
        if not 0.0 < self.temperature < float("inf"):
            raise ValueError(f"temperature must be positive and finite, got {self.temperature}")
        if not 0.0 < self.beta_bounds[0] <= self.beta_bounds[1] < float("inf"):
            raise ValueError(f"beta_bounds must be positive, finite and in order, got {self.beta_bounds}")
        if not self.eta[0] <= self.eta[1]:
            raise ValueError(f"eta must be a lower and an upper bound, got {self.eta}")
        if not self.target_ess >= 1.0:
            raise ValueError(f"target_ess must be at least one sample, got {self.target_ess}")

    def launch(self, state: WeightingState) -> None:
        """Write ``state.weight``, ``state.eta`` and ``state.beta`` from ``state.cost``; capture-safe."""
        bounds = wp.vec2(*self.beta_bounds)
        if self.adapt == Adaptation.ESS:
            state.weigh(bisect_temperature_kernel, [self.target_ess, bounds], [state.beta])
        inputs = [wp.vec2(*self.eta), bounds, int(self.adapt == Adaptation.ETA)]
        state.weigh(importance_weight_kernel, inputs, [state.beta, state.eta, state.weight])


@dataclass(frozen=True, kw_only=True)
class PredictiveSampling:
    """The best sample carries all weight (Howell et al. 2022, Alg. 4)."""

    adapts_sigma: ClassVar[bool] = False

    def launch(self, state: WeightingState) -> None:
        """Write ``state.weight`` and ``state.eta`` from ``state.cost``; capture-safe."""
        state.weigh(best_weight_kernel, [], [state.eta, state.weight])


@dataclass(frozen=True, kw_only=True)
class CrossEntropy:
    """Elites carry equal weight; mean and σ follow them (Rubinstein 1999).

    Args:
        elites: Number of best samples that carry weight.
    """

    elites: int = 8

    adapts_sigma: ClassVar[bool] = True

    def __post_init__(self):
        if self.elites < 1:
            raise ValueError(f"elites must be at least one, got {self.elites}")

    def launch(self, state: WeightingState) -> None:
        """Write ``state.weight`` and ``state.eta`` from ``state.cost``; capture-safe."""
        state.weigh(elite_weight_kernel, [self.elites], [state.eta, state.weight])


@dataclass(frozen=True, kw_only=True)
class Tsallis:
    """Elites weigh w ∝ (1 - ΔS/γ)_+^{1/(r-1)}, γ the excess cost of the first sample that is none (2104.00241).

    Args:
        elites: Number of best samples that carry weight.
        entropic_index: r, above one; large ones weigh the elites equally.
    """

    elites: int = 8
    entropic_index: float = 2.0

    adapts_sigma: ClassVar[bool] = False

    def __post_init__(self):
        if self.elites < 1:
            raise ValueError(f"elites must be at least one, got {self.elites}")
        if not 1.0 < self.entropic_index < float("inf"):
            raise ValueError(f"entropic_index must be above one and finite, got {self.entropic_index}")

    def launch(self, state: WeightingState) -> None:
        """Write ``state.weight`` and ``state.eta`` from ``state.cost``; capture-safe."""
        state.weigh(tsallis_weight_kernel, [self.elites, 1.0 / (self.entropic_index - 1.0)], [state.eta, state.weight])
