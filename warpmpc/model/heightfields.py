# SPDX-License-Identifier: Apache-2.0
"""Heightfields of a scene as triangles. They are no shapes of its layout: they come from an asset's MJCF file."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

FINEST = 256
"""Heights in a row and in a column at most: as fine as is seen of a whole field, and 1.6 MB for a page."""


@dataclass(frozen=True)
class Surface:
    """The upper side of a heightfield, in the world."""

    name: str
    """Name of its geom."""
    points: np.ndarray
    """Corners ``[n, 3]`` [m], float32."""
    triangles: np.ndarray
    """Indices of corners ``[m, 3]``, counter-clockwise from above."""


def heightfields(model: mujoco.MjModel) -> list[Surface]:
    """The heightfields of a model that stand still, each of at most :data:`FINEST` heights each way.

    Args:
        model: MuJoCo model (``Plant.model``).
    """
    fixed = model.body_weldid[model.geom_bodyid] == 0
    geoms = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD) & fixed)
    if not len(geoms):
        return []
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return [_surface(model, data, int(geom)) for geom in geoms]


def _surface(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Surface:
    """The surface of one geom: rows run along y, columns along x, heights are shares of the highest, as in MJCF."""
    field = model.geom_dataid[geom]
    rows, columns, first = (int(a[field]) for a in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    height = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    half_x, half_y, top, _ = model.hfield_size[field]
    i, j = _chosen(rows), _chosen(columns)
    x, y = np.meshgrid(half_x * (2.0 * j / (columns - 1) - 1.0), half_y * (2.0 * i / (rows - 1) - 1.0))
    local = np.stack([x, y, top * height[np.ix_(i, j)]], axis=-1).reshape(-1, 3)
    points = local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    corner = np.arange(len(i) * len(j)).reshape(len(i), len(j))
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Surface(model.geom(geom).name or f"heightfield_{geom}", points.astype(np.float32), triangles)


def _chosen(count: int) -> np.ndarray:
    """Choice of the lines that are shown: the first and the last, and evenly spread ones in between."""
    return np.unique(np.linspace(0, count - 1, min(count, FINEST)).round().astype(int))
