# SPDX-License-Identifier: Apache-2.0
"""Learned collision terms: small networks in place of geometry."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ...kernels.cost.view import StepView, joint_position
from ...physics.runtime.files import read_npz
from ...scene.model.spheres import self_fingerprint
from ...scene.types import NonNegative
from ..binding import Binding
from ..code import learned as source
from ..keys import TermKeys, term

UNITS = wp.constant(64)
"""Most inputs, and most units of the second row, of a network."""

Units = wp.types.vector(length=UNITS, dtype=float)


@dataclass(frozen=True)
class Weights:
    """Content of a file of weights: inputs by column, outputs by row reversed, as they were trained."""

    joints: tuple[str, ...]
    trained_for: str
    weights: tuple[np.ndarray, np.ndarray, np.ndarray]  # [2n, H], [H, U], [U, 1]
    biases: tuple[np.ndarray, np.ndarray, np.ndarray]  # [H], [U], [1]

    @classmethod
    def load(cls, path: Path) -> "Weights":
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
        if sizes[0] > int(UNITS) or sizes[2] > int(UNITS):
            raise ValueError(f"more than {UNITS} inputs, or units in the second row")
        if not all(np.isfinite(x).all() for x in (*weights, *biases)):
            raise ValueError("numbers that are not finite")
        return cls(joints, trained_for, weights, biases)

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Parameters ``first``, ``second`` and ``last``."""
        return filled(self.weights, self.biases)


def filled(weights: Sequence[np.ndarray], biases: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights and biases of three layers as terms take them, filled up with units that say nothing.

    Returns:
        ``[H, inputs + 1]``, the last column the biases; ``[H + 1, U]``, the last row the biases; ``[U + 1]``.
    """
    (w1, w2, w3), (b1, b2, b3) = weights, biases
    first = _filled(np.concatenate([w1, b1[None]]).T, source.FIRST, 0)
    second = _filled(_filled(w2, source.FIRST, 0), source.SECOND, 1)
    second = np.concatenate([second, _filled(b2[None], source.SECOND, 1)])
    return first, second, np.concatenate([_filled(w3[:, 0], source.SECOND, 0), b3])


def _filled(values: np.ndarray, block: int, axis: int) -> np.ndarray:
    """Zeros at the end of an axis, up to a multiple of a block."""
    pad = [(0, -size % block if i == axis else 0) for i, size in enumerate(values.shape)]
    return np.ascontiguousarray(np.pad(values, pad))


class LearnedSelfCollision(TermKeys):
    """Penetration of a robot's links into each other, as a network guesses it: max(0, margin + depth) [m]."""

    of: str | None = None
    """Robot; may be left out where it is the only one."""
    weights: str
    """File of ``tools/study.py train_self_collision`` (.npz), beside the scene or in its assets."""
    margin: NonNegative = 0.0
    """Links closer than this cost something [m]."""

    derived = {
        "coord": wp.array[int],  # [n] joint coordinates
        "first": wp.array2d[float],  # [H, 2n + 1] weights of sin q, of cos q, and the bias
        "second": wp.array2d[float],  # [H + 1, U], the last row the biases
        "last": wp.array[float],  # [U + 1], the last one the bias
    }

    def bind(self, p: Any, b: Binding) -> None:
        """Read the network [sin q, cos q] → H → U → 1."""
        robot, weights = b.only_robot(self.of), b.weights(self.weights, Weights.load)
        own = {
            name.partition("/")[2]: dof
            for dof, name in enumerate(b.layout.dof_name)
            if name.startswith(f"{robot.name}/")
        }
        if unknown := [name for name in weights.joints if name not in own]:
            raise b.error("were trained for a robot with other joints", "weights", found=unknown, allowed=own)
        dofs = [own[name] for name in weights.joints]
        given = next(r for r in b.scene.robot if r.name == robot.name).spheres
        if self_fingerprint(b.layout, robot, dofs, given) != weights.trained_for:
            raise b.error(
                "were trained for other links, shapes or limits, or with joints held elsewhere: train new ones with "
                "tools/study.py train_self_collision",
                "weights",
                found=self.weights,
            )
        first, second, last = weights.arrays()
        p.coord = b.array(b.layout.dof_coord[dofs], int)
        p.first, p.second, p.last = b.array(first, float), b.array(second, float), b.array(last, float)


@wp.func
def network_distance(s: StepView, p: LearnedSelfCollision.Params) -> float:
    """Output of the network for a configuration, positive where links penetrate [m]."""
    joints = p.coord.shape[0]
    inputs = Units()
    for i in range(joints):
        q = joint_position(s, p.coord[i])
        inputs[i] = wp.sin(q)
        inputs[joints + i] = wp.cos(q)
    rows = p.first.shape[0]
    units = p.second.shape[1]
    sums = Units()
    for u in range(units):
        sums[u] = p.second[rows, u]
    for h in range(rows):
        x = p.first[h, 2 * joints]
        for i in range(2 * joints):
            x += p.first[h, i] * inputs[i]
        x = wp.clamp(x, 0.0, 6.0)
        for u in range(units):
            sums[u] += x * p.second[h, u]
    d = p.last[units]
    for u in range(units):
        d += p.last[u] * wp.clamp(sums[u], 0.0, 6.0)
    return d


@term("learned_self_collision", LearnedSelfCollision, source=source.learned_self_collision)
def learned_self_collision(s: StepView, p: LearnedSelfCollision.Params) -> float:
    """Penetration of links into each other by a network, max(0, margin + d), d the depth it predicts [m].

    The self-collision cost of Bhardwaj et al. 2021: positional encoding, two hidden rows, ReLU6.
    """
    return wp.max(0.0, p.margin + network_distance(s, p))
