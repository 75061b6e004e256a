# SPDX-License-Identifier: Apache-2.0
"""Operational-space control (Khatib 1987), the baseline in STORM: torques from the error of a pose, no foresight."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

import warpmpc
from warpmpc.scene.draw import draw_task

if TYPE_CHECKING:
    from warpmpc import Plant, Scene

PERIOD = 0.002
"""Time for which a torque is held [s]."""
FREQUENCY = 10.0
"""Of the critically damped error [rad/s]; its lag, 2 over it, is the ``lead`` with which scenes show what moves."""
POSTURE = 5.0
"""Of the way back to the start's posture, as far as the task leaves the joints free [rad/s]."""
FASTEST = (1.0, 2.0)
"""Speeds that the task asks for at most, where a pose is far away [m/s, rad/s]."""
LEAST = 0.01
"""Singular values of the task's inverse mass are inverted as if they were this at least [1/kg]."""


def with_torques(name: str, overrides: tuple[str, ...]) -> Scene:
    """A scene whose arm takes torques within its drive's limits, at its own period."""
    drive = warpmpc.load_scene(name, overrides=overrides).robot[0].drive[0]
    torques = f"robot.*.drive.limit={list(drive.effort_limit)}"
    changes = (f"timing.control_dt={PERIOD}", "plant.substeps=1", "robot.*.drive.mode=effort", torques)
    return warpmpc.load_scene(name, overrides=(*overrides, *changes))


class OperationalSpace:
    """τ = Jᵀ Λ (ẍ* - J̇ q̇ - J a) + Nᵀ M (q̈* - a), with the model that the plant has.

    Λ = (J M⁻¹ Jᵀ)⁻¹, Nᵀ = 1 - Jᵀ Λ J M⁻¹, a the accelerations without torques; ẍ* = ω² (x_goal - x) - 2 ω ẋ, and q̈*
    likewise to the posture of the start.

    Args:
        plant: The plant, driven by torques; its scene's goal says which frame follows, and whether with its rotation.
        fastest: Speeds that the error asks for at most [m/s, rad/s]; any when left out.
    """

    def __init__(self, plant: Plant, *, fastest: tuple[float, float] | None = None):
        layout, goal = plant.layout, plant.scene.goal
        frame = layout.frame(goal.target)
        self._plant, self._data, self._offset = (
            plant,
            mujoco.MjData(plant.model),
            layout.frame_pose[frame].astype(float),
        )
        self._body = plant.model.body(plant.compiled.body_name[layout.frame_body[frame]]).id
        self._dofs = np.asarray(layout.actuator_dof)
        self._most = None if fastest is None else 2.0 / FREQUENCY * np.array(fastest)  # errors that ask for them
        self._rows = 3 if goal.rotation is None else 6
        self._start, self._limits = (
            layout.joint_q[self._dofs].astype(float),
            (layout.control_lower, layout.control_upper),
        )
        self._jacobian, self._rate = np.zeros((6, plant.model.nv)), np.zeros((6, plant.model.nv))
        self._mass = np.zeros((plant.model.nv, plant.model.nv))

    def __call__(self, goal: np.ndarray) -> np.ndarray:
        """Torques ``[n]`` within the limits towards a pose ``[7]``, (x, y, z, qx, qy, qz, qw)."""
        self._plant.show(self._data)
        return np.clip(self.torque(self._data, goal), *self._limits)

    def torque(self, data: mujoco.MjData, goal: np.ndarray) -> np.ndarray:
        """The same without limits, from a state of the plant's model, which is brought up to date."""
        model, dofs = self._plant.model, self._dofs
        data.ctrl[:] = 0.0
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, self._mass)
        turn = Rotation.from_quat(data.xquat[self._body][[1, 2, 3, 0]])
        point = data.xpos[self._body] + turn.apply(self._offset[:3])
        mujoco.mj_jac(model, data, self._jacobian[:3], self._jacobian[3:], point, self._body)
        mujoco.mj_jacDot(model, data, self._rate[:3], self._rate[3:], point, self._body)
        jacobian, drift = self._jacobian[: self._rows, dofs], (self._rate @ data.qvel)[: self._rows]
        q, qd, adrift = data.qpos[dofs], data.qvel[dofs], data.qacc_smooth[dofs]
        inverse = np.linalg.inv(self._mass)[np.ix_(dofs, dofs)]
        miss = Rotation.from_quat(goal[3:]) * (turn * Rotation.from_quat(self._offset[3:])).inv()
        errors = [goal[:3] - point, miss.as_rotvec()]
        if self._most is not None:
            errors = [
                e * min(1.0, most / max(np.linalg.norm(e), 1e-9)) for e, most in zip(errors, self._most, strict=True)
            ]
        error = np.concatenate(errors)[: self._rows]
        wanted = FREQUENCY**2 * error - 2.0 * FREQUENCY * jacobian @ qd
        left, values, right = np.linalg.svd(jacobian @ inverse @ jacobian.T)
        task_mass = right.T @ np.diag(1.0 / np.maximum(values, LEAST)) @ left.T
        posture = POSTURE**2 * (self._start - q) - 2.0 * POSTURE * qd - adrift
        task = jacobian.T @ task_mass @ (wanted - drift - jacobian @ (adrift + posture))
        return task + np.linalg.solve(inverse, posture)


def follow(scene: Scene, seed: int, on_step: Callable[[Plant], Callable[[object, Plant, np.ndarray], None]]) -> tuple:
    """Follow a scene's goal until the plant is done.

    Args:
        scene: A scene as :func:`with_torques` makes it.
        seed: As of an episode.
        on_step: Makes from the plant what is called as an episode's ``on_step``, once in a control of the planner's.

    Returns:
        The plant, what ``on_step`` made, and the median time of the law [ms].
    """
    every = max(1, round(float(np.atleast_1d(scene.planner.dt)[0]) / PERIOD))
    plant = warpmpc.Plant(draw_task(scene, seed)[0], seed=seed)
    law, watch, times = OperationalSpace(plant), on_step(plant), []
    while not plant.done:
        plant.observe()
        before = time.perf_counter()
        torque = law(plant.task["goal"])
        times.append(1e3 * (time.perf_counter() - before))
        plant.apply(torque)
        if plant.steps % every == 0:
            watch(plant, plant, torque)
    return plant, watch, float(np.median(times))
