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
    from collections.abc import Iterable

    from ..scene.schema import Scene, Uniform
    from .batch_size import BatchSize
    from .layout import Layout


RESIZABLE = frozenset({"box", "sphere", "capsule", "cylinder", "ellipsoid"})
"""Shapes whose size may vary; others keep theirs."""


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

        A single draw is that of all.

        Raises:
            ValueError: If there are fewer draws than that needs.
        """
        if self.draws == 1:
            return np.zeros(shape.worlds, dtype=np.int32)
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
        SceneError: If the table names an entity that does not exist, or sizes of one that is all meshes.
    """
    names = tuple(scene.randomize)
    _require(names, "randomize", scene, layout)
    rules = [scene.randomize[name] for name in names]
    for name, rule in zip(names, rules, strict=True):
        kinds = {layout.shapes[shape].kind for shape in layout.entity(name).shapes}
        if rule.size is not None and not kinds & RESIZABLE:
            raise SceneError(
                f"sizes of {' and '.join(sorted(kinds)) or 'nothing'} cannot be drawn: leave it out",
                key=f"randomize.{name}.size",
                file=scene.path,
                allowed=sorted(RESIZABLE),
            )
    mass = _uniform([r.mass for r in rules], draws, 3 * seed)
    friction = _uniform([r.friction for r in rules], draws, 3 * seed + 1)
    sigma = wp.array([r.size.normal if r.size else 0.0 for r in rules], dtype=float, device="cpu")
    size = wp.zeros((draws, len(names), 3), dtype=float, device="cpu")
    if names:
        inputs = [sigma, 3 * seed + 2, 0, 0]
        wp.launch(normal_offset_kernel, dim=(draws, len(names)), inputs=inputs, outputs=[size], device="cpu")
    return Properties(names, mass, friction, size.numpy().astype(np.float64))


def with_factors(drawn: Properties | None, scene: Scene, layout: Layout) -> Properties | None:
    """Properties of a plant's things: those drawn, times ``plant.factor``.

    Args:
        drawn: One draw, None without any.
        scene: The scene.
        layout: Its layout.

    Returns:
        One draw; None where nothing was drawn and the plant has no factors.

    Raises:
        SceneError: If the table names an entity that does not exist, or scales one that has no size of its own.
    """
    factors = scene.plant.factor
    if not factors:
        return drawn
    _require(factors, "plant.factor", scene, layout)
    names = drawn.names if drawn else ()
    names += tuple(name for name in factors if name not in names)
    mass, friction, size = np.ones((1, len(names))), np.ones((1, len(names))), np.zeros((1, len(names), 3))
    if drawn:
        known = len(drawn.names)
        mass[:, :known], friction[:, :known], size[:, :known] = drawn.mass, drawn.friction, drawn.size
    sized = {item.name: item.size for item in (*scene.object, *scene.obstacle) if item.size is not None}
    for name, factor in factors.items():
        i = names.index(name)
        mass[0, i] *= factor.mass
        friction[0, i] *= factor.friction
        if factor.size == 1.0:
            continue
        if name not in sized:
            raise SceneError(
                "it has no size to scale", key=f"plant.factor.{name}.size", file=scene.path, allowed=sorted(sized)
            )
        extents = np.asarray(sized[name])
        size[0, i, : len(extents)] += (factor.size - 1.0) * (extents + size[0, i, : len(extents)])
    return Properties(names, mass, friction, size)


def _require(names: Iterable[str], key: str, scene: Scene, layout: Layout) -> None:
    """Refuse names that are no entity's."""
    allowed = [e.name for e in layout.entities]
    for name in names:
        if name not in allowed:
            raise SceneError("no such robot, object or obstacle", key=key, file=scene.path, found=name, allowed=allowed)


def _uniform(rules: list[Uniform | None], draws: int, seed: int) -> np.ndarray:
    spread = np.array([rule.uniform if rule else 0.0 for rule in rules], dtype=np.float32)
    scale = wp.zeros((draws, len(rules)), dtype=float, device="cpu")
    if rules:
        inputs = [wp.array(spread, dtype=float, device="cpu"), seed, 0, 0]
        wp.launch(uniform_scale_kernel, dim=scale.shape, inputs=inputs, outputs=[scale], device="cpu")
    factor = scale.numpy().astype(np.float64)
    ends = [rule is not None and rule.ends for rule in rules]
    return np.where(ends, 1.0 + np.copysign(spread, factor - 1.0), factor)
