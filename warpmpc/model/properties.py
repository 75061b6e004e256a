# SPDX-License-Identifier: Apache-2.0
"""Draws of randomized physical properties, one row per draw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.worlds.randomize import normal_offset_kernel, uniform_scale_kernel
from ..scene.errors import SceneError

if TYPE_CHECKING:
    from ..scene.schema import Scene
    from .batch_size import BatchSize
    from .layout import Layout


@dataclass(frozen=True)
class Properties:
    """Factors and offsets of randomized entities, ``N`` draws of ``n`` entities."""

    names: tuple[str, ...]
    mass: np.ndarray  # [N, n] factor
    friction: np.ndarray  # [N, n] factor
    size: np.ndarray  # [N, n, 3] added to each dimension [m]

    @property
    def draws(self) -> int:
        """Number of draws."""
        return len(self.mass)

    def of_worlds(self, shape: BatchSize) -> np.ndarray:
        """Draw of every world ``[W]``: its domain's when there are several, else its sample's, else its environment's.

        Raises:
            ValueError: If there are fewer draws than that needs.
        """
        count = next((n for n in (shape.domains, shape.samples) if n > 1), shape.envs)
        if self.draws < count:
            raise ValueError(f"{count} draws of physical properties are needed, {self.draws} were given")
        inner = 1 if shape.domains > 1 else shape.domains * (1 if shape.samples > 1 else shape.samples)
        return (np.arange(shape.worlds, dtype=np.int32) // inner) % count


def draw_properties(scene: Scene, layout: Layout, draws: int, seed: int) -> Properties:
    """Draw randomized properties; draws depend on the seed and the draw's index alone.

    Args:
        scene: The scene, whose ``randomize`` table says what varies.
        layout: Its layout.
        draws: Number of draws.
        seed: Seed.

    Raises:
        SceneError: If the table names an entity that does not exist.
    """
    names = tuple(scene.randomize)
    for name in names:
        try:
            layout.entity(name)
        except SceneError:
            allowed = [e.name for e in layout.entities]
            raise SceneError(
                "no such robot, object or obstacle", key="randomize", file=scene.path, found=name, allowed=allowed
            ) from None
    rules = [scene.randomize[name] for name in names]
    mass = _uniform([r.mass.uniform if r.mass else 0.0 for r in rules], draws, 3 * seed)
    friction = _uniform([r.friction.uniform if r.friction else 0.0 for r in rules], draws, 3 * seed + 1)
    sigma = wp.array([r.size.normal if r.size else 0.0 for r in rules], dtype=float, device="cpu")
    size = wp.zeros((draws, len(names), 3), dtype=float, device="cpu")
    if names:
        inputs = [sigma, 3 * seed + 2, 0, 0]
        wp.launch(normal_offset_kernel, dim=(draws, len(names)), inputs=inputs, outputs=[size], device="cpu")
    return Properties(names, mass, friction, size.numpy().astype(np.float64))


def _uniform(spread: list[float], draws: int, seed: int) -> np.ndarray:
    scale = wp.zeros((draws, len(spread)), dtype=float, device="cpu")
    if spread:
        inputs = [wp.array(spread, dtype=float, device="cpu"), seed, 0, 0]
        wp.launch(uniform_scale_kernel, dim=scale.shape, inputs=inputs, outputs=[scale], device="cpu")
    return scale.numpy().astype(np.float64)
