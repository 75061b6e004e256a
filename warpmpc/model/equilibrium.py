# SPDX-License-Identifier: Apache-2.0
"""Controls that hold the start state: hover of a drone, gravity compensation of an arm with motors."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from .mujoco_model import make_world
from .safe import safe_command
from .state_rows import StateRows

if TYPE_CHECKING:
    from .compiled_scene import CompiledScene

_STEP = 0.002
"""Physics step of the model [s]; an equilibrium has none, servos of velocity are told one."""
_LEFT = 0.3
"""Share of the start's acceleration that may be left: an equilibrium leaves none, a robot in free fall all of it, and
a drone under a load that swings little."""


def with_equilibrium(compiled: CompiledScene) -> CompiledScene:
    """The scene with ``control_start`` that holds its start, where there is such a control and no keyframe has one.

    Position servos stay at their posture; the other controls come from inverse dynamics (MuJoCo's ``mj_inverse`` at
    zero acceleration) by least squares within their limits.
    """
    layout = compiled.layout
    free = np.flatnonzero((layout.control_safe < 0) & (layout.control_brake < 0))
    if layout.control_start.any() or not len(free) or not layout.nv:
        return compiled
    world = make_world(compiled, timestep=_STEP)
    model, data = world.model, mujoco.MjData(world.model)
    state = StateRows(layout, world)(layout.joint_q[None], np.zeros((1, layout.nv)), None)[0]
    data.qpos = state[: model.nq]
    safe = safe_command(layout, layout.joint_q[None], np.zeros((1, layout.nv)), 1.0)[0]

    def force(control: np.ndarray) -> np.ndarray:
        """Generalized forces of all actuators ``[nv]``."""
        data.ctrl = world.actuator_matrix @ control + world.actuator_offset
        mujoco.mj_forward(model, data)
        return data.qfrc_actuator.copy()

    without = force(safe)
    each = np.stack([force(safe + unit) - without for unit in np.eye(layout.nu)[free]], axis=1)
    data.qacc = 0.0
    mujoco.mj_inverse(model, data)
    moved = np.isin(model.dof_treeid, model.dof_treeid[np.abs(each).max(axis=1) > 0.0])
    if not moved.any():
        return compiled
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    root = np.linalg.cholesky(mass[np.ix_(moved, moved)])  # the error is an acceleration, weighed by kinetic energy
    wanted = solve_triangular(root, (data.qfrc_inverse - without)[moved], lower=True)
    matrix = solve_triangular(root, each[moved], lower=True)
    scale = np.linalg.norm(wanted)
    if scale < 1e-6:
        return compiled
    found = lsq_linear(matrix, wanted, bounds=(layout.control_lower[free], layout.control_upper[free]))
    if np.linalg.norm(matrix @ found.x - wanted) > _LEFT * scale:
        return compiled
    control = np.zeros(layout.nu, dtype=np.float32)
    control[free] = found.x
    return replace(compiled, layout=replace(layout, control_start=control))
