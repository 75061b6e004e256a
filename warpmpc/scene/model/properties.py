# SPDX-License-Identifier: Apache-2.0
"""Draws of randomized physical properties, one row per draw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...kernels.engine.randomize import DrawRules, Draws, draw_kernel
from ..errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ..schema import Randomization, Scene
    from .layout import Layout
    from .trajectory import BatchSize


RESIZABLE = frozenset({"box", "sphere", "capsule", "cylinder", "ellipsoid"})
"""Shapes whose size may vary; others keep theirs."""


@dataclass(frozen=True)
class Rules:
    """Distributions that properties of entities are drawn from."""

    entities: tuple[Randomization, ...]
    seed: int

    def on(self, device: str) -> DrawRules:
        """The same for kernels."""

        def array(values: list, dtype: type = float) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        out, rules = DrawRules(), self.entities
        for name in ("mass", "friction"):
            told = [getattr(rule, name) for rule in rules]
            setattr(out, name, array([rule.uniform if rule else 0.0 for rule in told]))
            setattr(out, f"{name}_ends", array([bool(rule and rule.ends) for rule in told], int))
        out.size = array([rule.size.normal if rule.size else 0.0 for rule in rules])
        out.redraw, out.seed = array([rule.redraw for rule in rules], int), self.seed
        return out


@dataclass(frozen=True)
class Properties:
    """Factors and offsets of randomized entities, ``N`` draws of ``n`` entities."""

    names: tuple[str, ...]
    mass: np.ndarray  # [N, n] factor
    friction: np.ndarray  # [N, n] factor
    size: np.ndarray  # [N, n, 3] added to each dimension [m]
    rules: Rules | None = None  # by which they were drawn, and may be again

    @property
    def redrawn(self) -> bool:
        """Return whether any are drawn anew in every plan."""
        return self.rules is not None and any(rule.redraw for rule in self.rules.entities)

    @property
    def sized(self) -> np.ndarray:
        """Entities whose size is drawn ``[n]``."""
        drawn = [bool(rule.size and rule.size.normal) for rule in self.rules.entities] if self.rules else False
        return self.size.any(axis=(0, 2)) | drawn

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
    out, own = Draws(), Rules(tuple(rules), 3 * seed)
    shape = (draws, len(names))
    out.mass, out.friction = (wp.zeros(shape, dtype=wp.float64, device="cpu") for _ in range(2))
    out.size = wp.zeros((*shape, 3), dtype=wp.float64, device="cpu")
    if names:
        inputs = [own.on("cpu"), wp.zeros(1, dtype=int, device="cpu")]
        wp.launch(draw_kernel, dim=shape, inputs=inputs, outputs=[out], device="cpu")
    return Properties(names, *(getattr(out, name).numpy() for name in ("mass", "friction", "size")), own)


def extremes(properties: Properties) -> Properties:
    """Draws at the ends of what may be drawn, by which one sees what follows from them.

    The first is nominal; then comes each kind by itself, frictions one against all others, and everything at once, each
    entity by another share.
    """
    rules = properties.rules.entities
    kinds = [r.mass for r in rules], [r.friction for r in rules]
    spread = [np.array([told.uniform if told else 0.0 for told in kind]) for kind in kinds]
    n, none = len(rules), np.zeros((len(rules), 3))
    end = 3.001 * np.array([rule.size.normal if rule.size else 0.0 for rule in rules])[:, None]
    rows = [(np.zeros(n), np.zeros(n), none)]
    for sign in (-1.0, 1.0):
        rows += [(sign * spread[0], np.zeros(n), none), (np.zeros(n), sign * spread[1], none)]
        rows += [(np.zeros(n), sign * np.where(np.arange(n) == i, -1.0, 1.0) * spread[1], none) for i in range(n)]
        rows += [(np.zeros(n), np.zeros(n), sign * end * np.ones(3))]
        share = sign * (1.0 + np.arange(n)) / n
        rows += [(share * spread[0], -0.7 * share * spread[1], share[:, None] * end * np.array([0.3, -0.9, 0.5]))]
    mass, friction, size = (np.array(column) for column in zip(*rows, strict=True))
    return Properties(properties.names, 1.0 + mass, 1.0 + friction, size, properties.rules)


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
