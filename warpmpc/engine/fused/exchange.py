# SPDX-License-Identifier: Apache-2.0
"""What a scene and its rollouts tell each other: the observed state, controls, watched forces, the record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...kernels.geometry.kinematics import BALL, FREE
from ...model.layout import Layout
from .tables import floats, ints


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
class Exchange:
    """Where the model keeps what the layout of a scene names.

    Args:
        layout: What is observed and recorded; None for the model's own coordinates and velocities.
        joint_q: First coordinate in the model of each of the layout's joints, -1 where it has none.
        joint_qd: First velocity of the same.
        bodies: The model's body behind each of the layout's.
        matrix: From controls to the model's ``ctrl`` ``[model.nu, nu]``.
        offset: Of the same ``[model.nu]``.
        mocap: Mocap body of the model behind each of the layout's.
        movable: The same behind each obstacle that moves with the task.
        activations: The model's activation behind each of the layout's.
        watched: Watched pairs of geoms.
        pairs: How many pairs of entities are watched.
        own_start: Whether every world starts in a state of its own, not in the one observed; always without a layout.
    """

    layout: Layout | None
    matrix: np.ndarray
    offset: np.ndarray
    joint_q: Sequence[int] = ()
    joint_qd: Sequence[int] = ()
    bodies: Sequence[int] = ()
    mocap: Sequence[int] = ()
    movable: Sequence[int] = ()
    activations: Sequence[int] = ()
    watched: Sequence[Watch] = ()
    pairs: int = 0
    own_start: bool = False

    @cached_property
    def rows(self) -> list[int]:
        """Row of each of the layout's bodies among those whose poses are kept."""
        kept = sorted(set(self.bodies))
        return [kept.index(body) for body in self.bodies]

    @cached_property
    def coordinates(self) -> dict[int, int]:
        """Coordinate of the model behind each of the layout's, but for those of joints that :attr:`turns` has."""
        return self._straight(self.joint_q, 0)

    @cached_property
    def speeds(self) -> dict[int, int]:
        """The same of velocities."""
        return self._straight(self.joint_qd, 1)

    def _straight(self, start: Sequence[int], which: int) -> dict[int, int]:
        out = {}
        for j, *first in self._joints(turning=False):
            out |= {first[which] + i: int(start[j]) + i for i in range(int(self.layout.joint_dof_dim[j].sum()))}
        return out

    @cached_property
    def turns(self) -> list[tuple[int, int, int]]:
        """Free and ball joints, and the first coordinate and velocity of each."""
        return self._joints(turning=True)

    def _joints(self, *, turning: bool) -> list[tuple[int, int, int]]:
        """Those of the layout's joints that the model has, and their first coordinate and velocity."""
        if self.layout is None:
            return []
        layout, out = self.layout, []
        for j, (q, v) in enumerate(zip(layout.joint_q_start, layout.joint_qd_start, strict=True)):
            if self.joint_q[j] >= 0 and (int(layout.joint_type[j]) in (int(FREE), int(BALL))) == turning:
                out.append((j, int(q), int(v)))
        return out

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        return {
            "PLAIN": int(self.layout is None),
            "OWN_STATE": int(self.own_start or self.layout is None),
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
        }

    def tables(self, pairs: int, groups: Sequence[int]) -> list[str]:
        """Definitions of the tables.

        Args:
            pairs: How many pairs of geoms there are.
            groups: Group of each.
        """
        used = [np.flatnonzero(row) for row in self.matrix]
        centres = [] if self.layout is None else self.layout.body_com
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
            floats("body_centre", centres),
            ints("quaternion_order", (0, 1, 2, 4, 5, 6, 3)),
            *self._watch_tables(pairs, groups),
        ]

    def _turn_tables(self) -> list[str]:
        if not self.turns:
            return []
        layout, joints = self.layout, [j for j, _, _ in self.turns]
        return [
            ints("turn_ball", layout.joint_type[joints] == int(BALL)),
            ints("turn_q", [q for _, q, _ in self.turns]),
            ints("turn_v", [v for _, _, v in self.turns]),
            ints("turn_model_q", [self.joint_q[j] for j in joints]),
            ints("turn_model_v", [self.joint_qd[j] for j in joints]),
            ints("turn_body", layout.joint_child[joints]),
            floats("turn_parent", layout.joint_pose_parent[joints]),
            floats("turn_child", layout.joint_pose_child[joints]),
        ]

    def _watch_tables(self, pairs: int, groups: Sequence[int]) -> list[str]:
        if not self.watched:
            return []
        signs = np.zeros((self.pairs, pairs))
        for watch in self.watched:
            signs[watch.index, watch.pair] += watch.sign
        seen = {groups[watch.pair] for watch in self.watched}
        return [floats("watch_sign", signs), ints("group_watched", [g in seen for g in range(max(groups) + 1)])]
