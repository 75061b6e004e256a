# SPDX-License-Identifier: Apache-2.0
"""A hand in a plant's world: it takes hold of a body and pulls or turns it, as the mouse does in MuJoCo's viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..scene.errors import SceneError

if TYPE_CHECKING:
    from ..engine.mujoco import MujocoSimulator
    from ..model.compiled import CompiledScene

STEPS = 0.4
"""Stiffest spring: this over the length of a control is its angular frequency, as the force is held that long."""


class Perturbation:
    """Holds at most one body, by damped springs that are as stiff as what they move is heavy.

    The springs are MuJoCo's (``mjv_applyPerturbForce``): one from the point taken hold of to where the hand is, one
    from the body's orientation to the hand's. Their force and moment are computed before every control and held for
    its length.

    Args:
        compiled: The scene, compiled.
        engine: Worlds that bodies can be pushed in.
        world: Which of them.
    """

    def __init__(self, compiled: CompiledScene, engine: MujocoSimulator, world: int):
        self._engine, self._world, self._model = engine, world, engine.models[world]
        names = zip(compiled.layout.body_name, compiled.body_name, strict=True)
        self._body = {name: self._model.body(own).id for name, own in names}
        frequency, springs = STEPS / (engine.steps * self._model.opt.timestep), self._model.vis.map
        springs.stiffness = min(springs.stiffness, frequency**2)
        springs.stiffnessrot = min(springs.stiffnessrot, frequency**2)
        self._data = mujoco.MjData(self._model)
        self._grip = mujoco.MjvPerturb()
        self.body: str | None = None
        """Body held, None for none."""

    def grab(self, body: str, point: np.ndarray) -> None:
        """Take hold of a body where it is at a point of the world ``[3]`` [m]; until it is moved, the hand is there.

        Raises:
            SceneError: If there is no such body.
        """
        if body not in self._body:
            raise SceneError("no such body", key="body", found=body, allowed=list(self._body))
        self._take_state()
        model, data, grip, index = self._model, self._data, self._grip, self._body[body]
        turned = data.xmat[index].reshape(3, 3)
        grip.select, grip.active = index, 0
        grip.localpos[:] = turned.T @ (np.asarray(point) - data.xpos[index])
        grip.refselpos[:] = point
        mujoco.mju_mulQuat(grip.refquat, data.xquat[index], model.body_iquat[index])
        self._held = grip.refquat.copy()
        grip.localmass = self._mass(point, index)
        self.body = body

    def pull(self, point: np.ndarray) -> None:
        """Put the hand at a point of the world ``[3]`` [m]; what it holds is pulled there."""
        self._grip.refselpos[:] = point
        self._grip.active = int(mujoco.mjtPertBit.mjPERT_TRANSLATE)

    def turn(self, rotation: np.ndarray) -> None:
        """Turn the hand, and what it holds with it, by a rotation vector in the world ``[3]`` [rad] since the grab."""
        angle = float(np.linalg.norm(rotation))
        turned = np.zeros(4)
        mujoco.mju_axisAngle2Quat(turned, np.asarray(rotation) / max(angle, 1e-9), angle)
        mujoco.mju_mulQuat(self._grip.refquat, turned, self._held)
        self._grip.active = int(mujoco.mjtPertBit.mjPERT_ROTATE)

    def release(self) -> None:
        """Let go."""
        if self.body is not None:
            self.body = None
            self._engine.wrenches(self._world)[:] = 0.0

    @property
    def spring(self) -> np.ndarray | None:
        """Ends of the spring that pulls, at the body and at the hand, ``[2, 3]`` [m]; None if nothing is pulled at."""
        if self.body is None or not self._grip.active & int(mujoco.mjtPertBit.mjPERT_TRANSLATE):
            return None
        self._take_state()
        data, grip = self._data, self._grip
        at = data.xpos[grip.select] + data.xmat[grip.select].reshape(3, 3) @ grip.localpos
        return np.stack([at, grip.refselpos])

    def act(self) -> None:
        """Give the engine the force and moment to hold during the next control."""
        if self.body is None:
            return
        self._take_state()
        self._data.xfrc_applied[:] = 0.0
        mujoco.mjv_applyPerturbForce(self._model, self._data, self._grip)
        self._engine.wrenches(self._world)[:] = self._data.xfrc_applied

    def _take_state(self) -> None:
        """Bring poses and velocities to where the world is."""
        self._engine.show(self._world, self._data)
        mujoco.mj_forward(self._model, self._data)

    def _mass(self, point: np.ndarray, body: int) -> float:
        """Apparent mass at a point to a pull there, the mean of all directions [kg]."""
        jacobian, moved = np.zeros((3, self._model.nv)), np.zeros((3, self._model.nv))
        mujoco.mj_jac(self._model, self._data, jacobian, None, np.asarray(point, dtype=float), body)
        mujoco.mj_solveM(self._model, self._data, moved, jacobian)
        return 3.0 / max(float(np.sum(jacobian * moved)), 1e-9)
