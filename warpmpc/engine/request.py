# SPDX-License-Identifier: Apache-2.0
"""Inputs that every engine is built from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import warp as wp

    from ..cost.stack import CostStack
    from ..kernels.planning.splines import Spline
    from ..model.batch_size import BatchSize
    from ..model.compiled import CompiledScene
    from ..model.properties import Properties
    from ..scene.schema import Scene
    from ..task.observed import ObservedState
    from .timegrid import TimeGrid


@dataclass(frozen=True, kw_only=True)
class EngineRequest:
    """What an engine is built for."""

    scene: Scene
    compiled: CompiledScene
    shape: BatchSize
    """Sizes of the batch."""
    grid: TimeGrid
    """Times and weights of the steps of a rollout."""
    spline: Spline
    """Spline from knots to controls, on the device."""
    limits: tuple[wp.array, wp.array]
    """Lower and upper limits of the controls ``[nu]``, on the device."""
    state: ObservedState
    """What rollouts start from, on the device."""
    costs: CostStack
    """The cost terms, on the device."""
    device: str
    properties: Properties | None = None
    """Draws of physical properties, None for nominal worlds."""


@dataclass(frozen=True)
class PhysicsSteps:
    """Physics steps of a rollout."""

    count: tuple[int, ...]
    """How many there are in each step of the rollout ``[T]``."""
    length: tuple[float, ...]
    """Length of one of them in each step of the rollout ``[T]`` [s], the same everywhere unless ``any_dt``."""
