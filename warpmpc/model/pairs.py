# SPDX-License-Identifier: Apache-2.0
"""Pairs of entities whose contact force is watched."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

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
