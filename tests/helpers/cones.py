# SPDX-License-Identifier: Apache-2.0
"""Shapes that touch with friction of all kinds."""

import mujoco
import numpy as np
from fused_models import CONTACTS, compile_model

PYRAMID, ELLIPSE = int(mujoco.mjtCone.mjCONE_PYRAMIDAL), int(mujoco.mjtCone.mjCONE_ELLIPTIC)


def rubbing(cone: int, impratio: float, condims: tuple[int, ...], seed: int = 1) -> mujoco.MjModel:
    """The shapes that touch, with friction of all kinds, and a gap, which changes no force."""
    model, rng = compile_model(CONTACTS), np.random.default_rng(seed)
    model.opt.cone, model.opt.impratio = cone, impratio
    rubs = model.geom_condim != 1
    model.geom_condim[rubs] = rng.permutation(np.resize(condims, rubs.sum()))
    model.geom_friction[:, 1] *= rng.uniform(1.0, 20.0, model.ngeom)
    model.geom_friction[:, 2] *= rng.uniform(10.0, 400.0, model.ngeom)
    model.geom_gap[:] = 0.01
    return model
