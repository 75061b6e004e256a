# SPDX-License-Identifier: Apache-2.0
"""Places of the numbers that rollouts take from outside and hand out, as tables of the source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from .sensors import Readings
from .source_parts import floats, ints


@dataclass(frozen=True)
class Watch:
    """A pair of geoms whose contact force counts towards a watched pair of entities."""

    pair: int
    """Number of the pair of geoms."""
    index: int
    """Number of the watched pair."""
    sign: float
    """1 where the force on the second geom is the force on the first entity."""


@dataclass(frozen=True, kw_only=True)
class Turn:
    """A free or ball joint outside, whose numbers are converted: anchors, order of quaternions, frames of twists."""

    joint: int
    """Number of the joint outside."""
    ball: bool
    q: int
    """Its first coordinate outside."""
    v: int
    """Its first velocity outside."""
    model_q: int
    model_v: int
    body: int
    """The body outside that it moves."""
    parent: np.ndarray
    """Pose of its anchor in the parent (x, y, z, qx, qy, qz, qw)."""
    child: np.ndarray
    """The same in the child."""

    @property
    def width(self) -> tuple[int, int]:
        """Number of its coordinates and of its velocities."""
        return (4, 3) if self.ball else (7, 6)


@dataclass(frozen=True, kw_only=True)
class StateMap:
    """From numbers outside to those of the model, and back.

    Args:
        matrix: From controls to the model's ``ctrl`` ``[model.nu, nu]``.
        offset: Of the same ``[model.nu]``.
        plain: Whether the numbers outside are the model's own coordinates and velocities; the rest is left out then.
        own_start: Whether every world starts in its own state, not in the one observed.
        coordinates: Coordinate of the model behind each one outside, but for those of :attr:`turns`.
        speeds: The same of velocities.
        turns: Free and ball joints.
        bodies: The model's body behind each one outside.
        centres: Centre of mass of each of these, in its frame ``[nb, 3]`` [m].
        mocap: Mocap body of the model behind each one outside.
        movable: Mocap body of the model behind each of the last poses of ``RolloutWork.pose``.
        activations: The model's activation behind each one outside.
        watched: Watched pairs of geoms.
        pairs: Number of watched pairs of entities.
        sensors: How many of the model's sensors are read, the first ones.
        sensed: Bodies whose poses and velocities these need.
        readings: What leaves what they show for terms and the record.
    """

    matrix: np.ndarray
    offset: np.ndarray
    plain: bool = False
    own_start: bool = False
    coordinates: Mapping[int, int] = field(default_factory=dict)
    speeds: Mapping[int, int] = field(default_factory=dict)
    turns: Sequence[Turn] = ()
    bodies: Sequence[int] = ()
    centres: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    mocap: Sequence[int] = ()
    movable: Sequence[int] = ()
    activations: Sequence[int] = ()
    watched: Sequence[Watch] = ()
    pairs: int = 0
    sensors: int = 0
    sensed: frozenset[int] = frozenset()
    readings: Readings = field(default_factory=Readings)

    @cached_property
    def kept(self) -> list[int]:
        """The model's bodies whose poses and velocities are kept."""
        return sorted({*self.bodies, *self.sensed})

    @cached_property
    def rows(self) -> list[int]:
        """Row of each body outside among those whose poses are kept."""
        return [self.kept.index(body) for body in self.bodies]

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        return {
            "PLAIN": int(self.plain),
            "OWN_STATE": int(self.own_start or self.plain),
            "NCONTROL": max(1, self.matrix.shape[1]),
            "DRIVES": len(self.matrix),
            "MOCAPS": len(self.mocap),
            "MOVABLES": len(self.movable),
            "COORDINATES": len(self.coordinates),
            "SPEEDS": len(self.speeds),
            "TURNS": len(self.turns),
            "ACTIVATIONS": len(self.activations),
            "BODIES": len(self.bodies),
            "WATCHED": self.pairs if self.watched else 0,
            "READINGS": len(self.readings.places),
        }

    def tables(self, pairs: int, groups: Sequence[int]) -> list[str]:
        """Definitions of the tables.

        Args:
            pairs: Number of pairs of geoms.
            groups: Group of each.
        """
        used = [np.flatnonzero(row) for row in self.matrix]
        return [
            ints("drive_first", np.cumsum([0, *map(len, used)])),
            ints("drive_of", np.concatenate([*used, []])),
            floats("drive_factor", np.concatenate([*(row[n] for row, n in zip(self.matrix, used, strict=True)), []])),
            floats("drive_offset", self.offset),
            ints("mocap_of", self.mocap),
            ints("movable_of", self.movable),
            ints("layout_q", list(self.coordinates)),
            ints("model_q", list(self.coordinates.values())),
            ints("layout_v", list(self.speeds)),
            ints("model_v", list(self.speeds.values())),
            ints("act_of", self.activations),
            *self._turn_tables(),
            ints("body_row", self.rows),
            floats("body_centre", self.centres),
            ints("quaternion_order", (0, 1, 2, 4, 5, 6, 3)),
            *self._watch_tables(pairs, groups),
            *self.readings.tables,
        ]

    def _turn_tables(self) -> list[str]:
        turns = self.turns
        if not turns:
            return []
        return [
            ints("turn_ball", [turn.ball for turn in turns]),
            ints("turn_q", [turn.q for turn in turns]),
            ints("turn_v", [turn.v for turn in turns]),
            ints("turn_model_q", [turn.model_q for turn in turns]),
            ints("turn_model_v", [turn.model_v for turn in turns]),
            ints("turn_body", [turn.body for turn in turns]),
            floats("turn_parent", [turn.parent for turn in turns]),
            floats("turn_child", [turn.child for turn in turns]),
        ]

    def _watch_tables(self, pairs: int, groups: Sequence[int]) -> list[str]:
        if not self.watched:
            return []
        signs = np.zeros((self.pairs, pairs))
        for watch in self.watched:
            signs[watch.index, watch.pair] += watch.sign
        seen = {groups[watch.pair] for watch in self.watched}
        return [floats("watch_sign", signs), ints("group_watched", [g in seen for g in range(max(groups) + 1)])]
