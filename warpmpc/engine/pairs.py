# SPDX-License-Identifier: Apache-2.0
"""Pairs of entities whose contact force is watched."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..scene.layout import Layout


@dataclass(frozen=True)
class Pair:
    """Two entities whose net contact force is watched; forces act on the first."""

    first: str
    second: str


def collision_pairs(layout: Layout) -> tuple[Pair, ...]:
    """Every robot and object against every obstacle: the contacts that count as collisions in reports."""
    movers = layout.group("robots") + layout.group("objects")
    return tuple(Pair(m.name, o.name) for m in movers for o in layout.group("obstacles"))
