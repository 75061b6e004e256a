# SPDX-License-Identifier: Apache-2.0
"""Inputs that every engine is built from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

from ..cost.weights import cost_weights
from ..model.batch_size import BatchSize
from .timegrid import TimeGrid

if TYPE_CHECKING:
    import warp as wp

    from ..cost.stack import CostStack
    from ..kernels.planning.costs import CostWeights
    from ..kernels.planning.splines import Spline
    from ..model.compiled import CompiledScene
    from ..model.properties import Properties
    from ..scene.schema import Scene
    from ..task.observed import ObservedState


@dataclass(frozen=True, kw_only=True)
class EngineRequest:
    """Inputs that an engine is built from."""

    scene: Scene
    compiled: CompiledScene
    shape: BatchSize
    """Sizes of the batch."""
    grid: TimeGrid
    """Times and discount of the steps of a rollout."""
    spline: Spline
    """Spline from knots to controls, on the device."""
    limits: tuple[wp.array, wp.array]
    """Lower and upper limits of the controls ``[nu]``, on the device."""
    state: ObservedState
    """Start of the rollouts, on the device."""
    costs: CostStack
    """The cost terms, on the device."""
    device: str
    properties: Properties | None = None
    """Draws of physical properties, None for nominal worlds."""

    @cached_property
    def weights(self) -> CostWeights:
        """Factors on what the terms cost at every step, on the device."""
        return cost_weights(self.state.weight, self.costs.factors, self.grid.discount)

    def worlds(self, steps: PhysicsSteps) -> dict[str, Any]:
        """Arguments that all simulators share.

        Args:
            steps: Physics steps, of one length.
        """
        return {
            "substeps": steps.count,
            "timestep": steps.length[0],
            "pairs": self.costs.pairs,
            "properties": self.properties,
        }

    def one_step(self, steps: PhysicsSteps, worlds: int) -> tuple[Self, PhysicsSteps]:
        """Request and physics steps of nominal worlds that take one control step, so many of every environment."""
        shape, grid = BatchSize(self.shape.envs, worlds, 1, 1), TimeGrid(self.grid.dt[:1], self.grid.discount[:1])
        return replace(self, shape=shape, grid=grid, properties=None), PhysicsSteps(steps.count[:1], steps.length[:1])


@dataclass(frozen=True)
class PhysicsSteps:
    """Physics steps of a rollout."""

    count: tuple[int, ...]
    """Number in each step of the rollout ``[T]``."""
    length: tuple[float, ...]
    """Length of one of them in each step of the rollout ``[T]`` [s], the same everywhere unless ``any_dt``."""
