# SPDX-License-Identifier: Apache-2.0
"""Efforts that hold a robot against gravity."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..model.conversion import MujocoStates
from ..model.mujoco_model import make_world
from ..scene.errors import SceneError

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..model.state import State
    from ..scene.schema import Scene

_MOTOR = (
    int(mujoco.mjtTrn.mjTRN_JOINT),
    int(mujoco.mjtGain.mjGAIN_FIXED),
    int(mujoco.mjtBias.mjBIAS_NONE),
    int(mujoco.mjtDyn.mjDYN_NONE),
)
"""Transmission, gain, bias and dynamics of a motor."""
_ONE_DOF = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))


class Gravity:
    """Efforts that balance gravity and springs, by MuJoCo's inverse dynamics at rest: ``qfrc_bias - qfrc_passive``.

    Controls are efforts where a motor (a fixed gain, no bias, no state of its own) drives a joint of one degree of
    freedom. Contacts are left out, and so is whatever moves.

    Args:
        scene: The scene.
        compiled: The scene, compiled.

    Raises:
        SceneError: If no control is an effort.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene):
        world = make_world(compiled, timestep=scene.timing.control_dt)
        model = self._model = world.model
        self._data, self._states = mujoco.MjData(model), MujocoStates(compiled, model)
        found: dict[int, tuple[int, float, float]] = {}  # velocity coordinate → control, effort of one, offset
        for a in range(model.nu):
            columns = np.flatnonzero(world.actuator_matrix[a])
            if not _is_motor(model, a) or len(columns) != 1:
                continue
            each = float(model.actuator_gear[a, 0] * model.actuator_gainprm[a, 0])
            dof, factor = int(model.jnt_dofadr[model.actuator_trnid[a, 0]]), world.actuator_matrix[a, columns[0]]
            found.setdefault(dof, (int(columns[0]), each * factor, each * world.actuator_offset[a]))
        if not found:
            message = "no control of this scene is an effort: leave it out, drives hold or stop by themselves"
            raise SceneError(message, key="agent.safe", file=scene.path, found="gravity")
        self._dof = np.array(list(found))
        self._control = np.array([control for control, _, _ in found.values()])
        self._each = np.array([each for _, each, _ in found.values()])
        self._offset = np.array([offset for _, _, offset in found.values()])

    def __call__(self, state: State, control: np.ndarray) -> np.ndarray:
        """A control ``[nu]`` whose efforts are those that hold the robot.

        Args:
            state: Where the robot is, of one environment.
            control: What the other controls are.
        """
        model, data = self._model, self._data
        self._states.write(state, data)
        data.qvel[:] = 0.0
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        effort = (data.qfrc_bias - data.qfrc_passive)[self._dof]
        held = control.copy()
        held[self._control] = (effort - self._offset) / self._each
        return held


def _is_motor(model: mujoco.MjModel, a: int) -> bool:
    """Return whether an actuator's control is an effort along a joint of one degree of freedom."""
    kinds = (model.actuator_trntype, model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype)
    if tuple(int(kind[a]) for kind in kinds) != _MOTOR:
        return False
    straight = int(model.jnt_type[model.actuator_trnid[a, 0]]) in _ONE_DOF
    return straight and model.actuator_gear[a, 0] * model.actuator_gainprm[a, 0] != 0.0
