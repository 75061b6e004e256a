# SPDX-License-Identifier: Apache-2.0
"""Pairs of entities whose contact force is watched, on the host and on a device."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import warp as wp

from ..kernels.worlds.contacts import PairTable

if TYPE_CHECKING:
    from collections.abc import Collection

    from .layout import Layout


@dataclass(frozen=True)
class Pair:
    """Two entities whose net contact force is watched; forces act on the first."""

    first: str
    second: str


def collision_pairs(layout: Layout, supports: Collection[str] = ()) -> tuple[Pair, ...]:
    """Robots against each other, and every robot and object against every obstacle: what reports call collisions.

    Args:
        layout: Layout of the scene.
        supports: Obstacles that objects lie on; against these, robots alone count.
    """
    robots, objects, obstacles = (layout.group(name) for name in ("robots", "objects", "obstacles"))
    crashes = tuple(Pair(a.name, b.name) for a, b in itertools.combinations(robots, 2))
    return crashes + tuple(
        Pair(m.name, o.name) for m in robots + objects for o in obstacles if m in robots or o.name not in supports
    )


def touching_pairs(layout: Layout) -> tuple[Pair, ...]:
    """Every object against every robot and against the other objects: contacts that a task may be about."""
    robots, objects = layout.group("robots"), layout.group("objects")
    pairs = (*itertools.product(robots, objects), *itertools.combinations(objects, 2))
    return tuple(Pair(a.name, b.name) for a, b in pairs)


def pair_table(layout: Layout, pairs: tuple[Pair, ...], shapes: list[int], device: str) -> PairTable:
    """The watched pairs on a device.

    Args:
        layout: Layout of one world.
        pairs: Watched pairs.
        shapes: Layout shape of each shape (or geom) of the solver, -1 for none.
        device: Warp device.
    """
    names = [e.name for e in layout.entities]
    owner = {s: i for i, e in enumerate(layout.entities) for s in e.shapes}
    table = PairTable()
    table.shape_entity = wp.array([owner.get(s, -1) for s in shapes], dtype=int, device=device)
    table.first = wp.array([names.index(p.first) for p in pairs], dtype=int, device=device)
    table.second = wp.array([names.index(p.second) for p in pairs], dtype=int, device=device)
    return table
