# SPDX-License-Identifier: Apache-2.0
"""Pairs of geoms of a MuJoCo model that may touch, and geoms that rays meet."""

from __future__ import annotations

import mujoco
import numpy as np


def colliding_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Return whether two geoms may touch, by contype, conaffinity, parents, excludes and pairs ``[ngeom, ngeom]``."""
    bits, other = model.geom_contype.astype(np.int64), model.geom_conaffinity.astype(np.int64)
    meets = ((bits[:, None] & other) | (other[:, None] & bits)) != 0
    body = model.geom_bodyid
    weld = model.body_weldid
    parent = weld[model.body_parentid[weld]]
    same = weld[body][:, None] == weld[body]
    family = (parent[body][:, None] == weld[body]) & (weld[body] != 0)
    filtered = same | (0 if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT else family | family.T)
    meets &= ~filtered.astype(bool)
    for signature in model.exclude_signature:
        first, second = body == int(signature) >> 16, body == int(signature) & 0xFFFF
        meets &= ~((first[:, None] & second) | (second[:, None] & first))
    meets[model.pair_geom1, model.pair_geom2] = meets[model.pair_geom2, model.pair_geom1] = True
    return meets


def seen_geoms(m: mujoco.MjModel) -> set[int]:
    """Geoms that rangefinders see, none if there are no rangefinders."""
    if not (m.sensor_type == int(mujoco.mjtSensor.mjSENS_RANGEFINDER)).any():
        return set()
    material = m.geom_matid >= 0
    opacity = m.geom_rgba[:, 3].copy()
    opacity[material] = m.mat_rgba[m.geom_matid[material], 3]
    return set(np.flatnonzero(opacity).tolist())
