# SPDX-License-Identifier: Apache-2.0
"""Inverse inertias of a model, and what single precision makes of the extreme ones.

MuJoCo regularizes a row of constraint by the inverse inertia of the body's centre of mass. Where a joint goes through
that point the number is zero, and the row is hard to 15 digits. Single precision has no more than 7: no row is
regularized less than by :data:`LEAST_SHARE` of the inverse inertia of the points that touch.
"""

from __future__ import annotations

from itertools import product

import mujoco
import numpy as np

from .coefficients import LEAST

LEAST_SHARE = 1e-6
"""Least regularization of a row over the inverse inertia of its points."""
LEVER = 1e-8
"""Inverse inertia along a normal, over that of the points, up to which it may be rounding."""
LEAST_INERTIA = 1e-4
"""Least inertia of a degree of freedom while the others move freely, over that while they stand still: beyond it
rounding is multiplied by more than ten thousand."""
POSES = 4
"""Poses in which that is looked for."""


class Mobility:
    """Inverse inertias of points of a model where it starts, as traces over all directions.

    Args:
        model: The model.
    """

    def __init__(self, model: mujoco.MjModel):
        self._mj, self._data = model, mujoco.MjData(model)
        _factorize(model, self._data)
        self._geoms: dict[int, float] = {}

    def geom(self, geom: int) -> float:
        """The largest of a geom's corners [1/kg]."""
        if geom not in self._geoms:
            m, d = self._mj, self._data
            centre, half = m.geom_aabb[geom].reshape(2, 3)
            corners = [centre + half * signs for signs in product((-1.0, 1.0), repeat=3)] if half.any() else [centre]
            turn, body = d.geom_xmat[geom].reshape(3, 3), int(m.geom_bodyid[geom])
            self._geoms[geom] = max(self.point(body, d.geom_xpos[geom] + turn @ corner) for corner in corners)
        return self._geoms[geom]

    def place(self, body: int, at: np.ndarray) -> np.ndarray:
        """A point in the world's frame, given in a body's."""
        return self._data.xpos[body] + self._data.xmat[body].reshape(3, 3) @ at

    def point(self, body: int, point: np.ndarray) -> float:
        """Of a point in the world's frame that a body carries along [1/kg]."""
        jacobian = np.zeros((3, self._mj.nv))
        mujoco.mj_jac(self._mj, self._data, jacobian, None, point, body)
        return self._trace(jacobian)

    def turn(self, body: int) -> float:
        """Of a body's rotation [1/(kg m²)]."""
        jacobian = np.zeros((3, self._mj.nv))
        mujoco.mj_jacBody(self._mj, self._data, None, jacobian, body)
        return self._trace(jacobian)

    def _trace(self, jacobian: np.ndarray) -> float:
        if not jacobian.any():
            return 0.0
        solved = np.empty_like(jacobian)
        mujoco.mj_solveM(self._mj, self._data, solved, jacobian)
        return float((jacobian * solved).sum())


def floor(*mobilities: float) -> float:
    """Least regularization of a row between parts of these inverse inertias."""
    return max(LEAST_SHARE * sum(mobilities), LEAST)


def singular(model: mujoco.MjModel) -> bool:
    """Return whether single precision cannot factorize the mass matrix, where the model starts and in other poses."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for pose in range(POSES if model.nv else 0):
        data.qpos[:] = model.qpos0
        if pose:
            mujoco.mj_integratePos(model, data.qpos, rng.uniform(-1.5, 1.5, model.nv), 1.0)
        _factorize(model, data)
        diagonal = data.M[model.M_rowadr + model.M_rownnz - 1]
        if (data.qLDiagInv * diagonal * LEAST_INERTIA > 1.0).any():
            return True
    return False


def _factorize(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Mass matrix and its factors at the coordinates of the data."""
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_makeM, mujoco.mj_factorM):
        stage(model, data)
