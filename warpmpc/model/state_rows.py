# SPDX-License-Identifier: Apache-2.0
"""States of a scene as rows of its MuJoCo model's (qpos, qvel, act)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.worlds.clone import mujoco_state_kernel
from ..launch import Launcher
from .joints import joint_table

if TYPE_CHECKING:
    from .layout import Layout
    from .mujoco_model import MujocoWorld


class StateRows:
    """Turns joint coordinates and velocities into MuJoCo's.

    Args:
        layout: State layout.
        world: MuJoCo's model of the scene.
    """

    def __init__(self, layout: Layout, world: MujocoWorld):
        model = world.model
        self._nq, self._activation = model.nq, model.nq + model.nv + np.asarray(world.activation, dtype=int)
        self._width = 1 + model.nq + model.nv + model.na
        self._table = joint_table(layout, "cpu", mujoco_q=world.joint_q, mujoco_qd=world.joint_qd)
        self._launch = Launcher("cpu")

    def __call__(self, joint_q: np.ndarray, joint_qd: np.ndarray, act: np.ndarray | None = None) -> np.ndarray:
        """Rows ``[E, nx]`` of coordinates ``[E, nq]``, velocities ``[E, nv]`` and activations ``[E, na]``."""
        q, qd = (wp.array(np.asarray(a)[None], dtype=float, device="cpu") for a in (joint_q, joint_qd))
        rows = wp.zeros((len(joint_q), self._width), dtype=wp.float64, device="cpu")
        self._launch(mujoco_state_kernel, len(joint_q), [self._table, self._nq, q, qd, 0], [rows])
        out = rows.numpy()[:, 1:]
        if len(self._activation) and act is not None:
            out[:, self._activation] = act
        return out
