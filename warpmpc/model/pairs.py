# SPDX-License-Identifier: Apache-2.0
"""Pairs of entities whose contact force is watched, on the host and on a device."""

from __future__ import annotations

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
    """Every robot and object against every obstacle: the contacts that count as collisions in reports.

    Args:
        layout: Layout of the scene.
        supports: Obstacles that objects lie on; against these, robots alone count.
    """
    robots, objects, obstacles = (layout.group(name) for name in ("robots", "objects", "obstacles"))
    return tuple(
        Pair(m.name, o.name) for m in robots + objects for o in obstacles if m in robots or o.name not in supports
    )


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
