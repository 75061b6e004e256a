# SPDX-License-Identifier: Apache-2.0
"""Contact forces as arrows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .shapes import ContactPoints

FORCE_LENGTH = 0.005
"""Length of a force's arrow [m/N]."""
FORCE_LENGTH_MAX = 1.0
"""Longest arrow [m]."""
FORCE_COLOR = (255, 140, 0)


def arrows(
    force: np.ndarray, points: Sequence[ContactPoints], body_q: np.ndarray, *, smallest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arrows of the n pairs that touch: which pairs ``[n]``, origins ``[n, 3]`` and vectors ``[n, 3]`` [m].

    Args:
        force: Net force on the first of each pair ``[C, 3]`` [N].
        points: Where to draw each.
        body_q: Poses of bodies ``[nb, 7]``.
        smallest: Forces that are not larger are none [N].
    """
    size = np.linalg.norm(force, axis=1)
    touching = np.flatnonzero(size > smallest)
    origins = np.array([points[i](body_q) for i in touching]).reshape(-1, 3)
    length = np.minimum(FORCE_LENGTH * size[touching], FORCE_LENGTH_MAX)
    return touching, origins, force[touching] * (length / size[touching])[:, None]
