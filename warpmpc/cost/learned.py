# SPDX-License-Identifier: Apache-2.0
"""The learned collision terms: their keys in scene files, and how files of weights become parameters."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..kernels.terms import learned
from ..model.assets import resolve_asset
from ..model.npz import read_npz
from ..model.self_shape import self_fingerprint
from ..scene.errors import SceneError
from ..scene.types import NonNegative, Section
from .native import learned as native
from .term import CostTerm, parse_keys

if TYPE_CHECKING:
    from pathlib import Path

    from ..model.layout import Entity
    from .binding import Binding


class LearnedSelfCollision(Section):
    """Penetration of a robot's links into each other, as a network guesses it: max(0, margin + depth) [m]."""

    of: str | None = None
    """Robot; may be left out where it is the only one."""
    weights: str
    """File of ``tools/train_self_collision.py`` (.npz), beside the scene or in its assets."""
    margin: NonNegative = 0.0
    """Links closer than this cost something [m]."""


@dataclass(frozen=True)
class Weights:
    """Content of a file of weights: inputs by column, outputs by row reversed, as they were trained."""

    joints: tuple[str, ...]
    trained_for: str
    weights: tuple[np.ndarray, np.ndarray, np.ndarray]  # [2n, H], [H, U], [U, 1]
    biases: tuple[np.ndarray, np.ndarray, np.ndarray]  # [H], [U], [1]

    @classmethod
    def load(cls, path: Path) -> Weights:
        """Read a file.

        Raises:
            ValueError: If it holds something else, or numbers that are not finite.
        """
        with read_npz(path) as data:
            missing = {"joints", "trained_for", *(f"{x}{n}" for x in "wb" for n in (1, 2, 3))} - {*data.files}
            if missing:
                raise ValueError(f"it lacks {', '.join(sorted(missing))}")
            joints, trained_for = tuple(map(str, data["joints"])), str(data["trained_for"])
            weights, biases = (tuple(data[f"{x}{n}"].astype(np.float32) for n in (1, 2, 3)) for x in "wb")
        sizes = [2 * len(joints), *(len(b) for b in biases)]
        shapes = [list(w.shape) for w in weights]
        if shapes != [[a, b] for a, b in itertools.pairwise(sizes)] or sizes[3] != 1:
            raise ValueError(f"its weights have the shapes {shapes}")
        if sizes[0] > int(learned.UNITS) or sizes[2] > int(learned.UNITS):
            raise ValueError(f"more than {learned.UNITS} inputs, or units in the second row")
        if not all(np.isfinite(x).all() for x in (*weights, *biases)):
            raise ValueError("numbers that are not finite")
        return cls(joints, trained_for, weights, biases)

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Parameters ``first``, ``second`` and ``last``, filled up with units that say nothing."""
        (w1, w2, w3), (b1, b2, b3) = self.weights, self.biases
        first = _filled(np.concatenate([w1, b1[None]]).T, native.FIRST, 0)
        second = _filled(_filled(w2, native.FIRST, 0), native.SECOND, 1)
        second = np.concatenate([second, _filled(b2[None], native.SECOND, 1)])
        return first, second, np.concatenate([_filled(w3[:, 0], native.SECOND, 0), b3])


def _filled(values: np.ndarray, block: int, axis: int) -> np.ndarray:
    """Zeros at the end of an axis, up to a multiple of a block."""
    pad = [(0, -size % block if i == axis else 0) for i, size in enumerate(values.shape)]
    return np.ascontiguousarray(np.pad(values, pad))


def _robot(of: str | None, b: Binding) -> Entity:
    robots = {entity.name: entity for entity in b.layout.entities if entity.kind == "robot"}
    if of is None and len(robots) == 1:
        return next(iter(robots.values()))
    if of not in robots:
        what = "several robots: name one" if of is None else "no such robot"
        raise SceneError(what, key=f"{b.key}.of", file=b.file, found=of, allowed=robots)
    return robots[of]


def _learned_self_collision(keys: dict[str, Any], b: Binding) -> learned.LearnedSelfCollisionParams:
    v = parse_keys(LearnedSelfCollision, keys, b)
    robot, where = _robot(v.of, b), f"{b.key}.weights"

    def wrong(message: str, **more: Any) -> SceneError:
        return SceneError(message, key=where, file=b.file, **more)

    base = None if b.file is None else b.file.parent
    path = resolve_asset(v.weights, base=base, key=where, file=b.file)
    try:
        weights = Weights.load(path)
    except (OSError, ValueError) as error:
        raise wrong(f"cannot be read as weights: {error}", found=v.weights) from error
    own = {
        name.partition("/")[2]: dof for dof, name in enumerate(b.layout.dof_name) if name.startswith(f"{robot.name}/")
    }
    if unknown := [name for name in weights.joints if name not in own]:
        raise wrong("were trained for a robot with other joints", found=unknown, allowed=own)
    dofs = [own[name] for name in weights.joints]
    given = next(r for r in b.scene.robot if r.name == robot.name).spheres
    if self_fingerprint(b.layout, robot, dofs, given) != weights.trained_for:
        raise wrong(
            "were trained for other links, shapes or limits, or with joints held elsewhere: train new ones with "
            "tools/train_self_collision.py",
            found=v.weights,
        )
    p = learned.LearnedSelfCollisionParams()
    first, second, last = weights.arrays()
    p.coord, p.margin = b.array(b.layout.dof_coord[dofs], int), v.margin
    p.first, p.second, p.last = b.array(first, float), b.array(second, float), b.array(last, float)
    return p


TERMS = (
    CostTerm(
        "learned_self_collision",
        learned.learned_self_collision,
        learned.LearnedSelfCollisionParams,
        _learned_self_collision,
        LearnedSelfCollision,
        native.learned_self_collision,
    ),
)
