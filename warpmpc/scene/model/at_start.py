# SPDX-License-Identifier: Apache-2.0
"""A scene as physics at its start: its MuJoCo model, state and the controls that hold it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .control_values import safe_command
from .conversion import StateRows
from .mujoco_model import MujocoWorld, Options, make_world

if TYPE_CHECKING:
    from ..schema import Scene
    from .compiled import CompiledScene

STEP = 0.002
"""Physics step of the model [s]: MuJoCo's default."""


@dataclass(frozen=True)
class Subject:
    """A scene and its MuJoCo model in the start state."""

    scene: Scene
    compiled: CompiledScene

    @cached_property
    def world(self) -> MujocoWorld:
        """The scene's MuJoCo model with its servos."""
        return make_world(self.compiled, timestep=STEP, options=Options.of(self.scene.engine))

    @cached_property
    def start(self) -> mujoco.MjData:
        """The start state, after a forward pass."""
        model, layout = self.world.model, self.compiled.layout
        data = mujoco.MjData(model)
        act = layout.act[None] if len(layout.act) else None
        row = StateRows(layout, self.world)(layout.joint_q[None], layout.joint_qd[None], act)[0]
        data.qpos, data.qvel, data.act = np.split(row, [model.nq, model.nq + model.nv])
        mujoco.mj_forward(model, data)
        return data

    @cached_property
    def held(self) -> np.ndarray:
        """Controls that hold the start ``[nu]``: the layout's, else the safe ones, within their bounds."""
        layout = self.compiled.layout
        if layout.control_start.any():
            return np.array(layout.control_start, dtype=float)
        safe = safe_command(layout, layout.joint_q[None], np.zeros((1, layout.nv)), 1.0)[0]
        return np.clip(safe, layout.control_lower, layout.control_upper).astype(float)

    @cached_property
    def owner(self) -> np.ndarray:
        """Index of the entity that each body belongs to ``[nbody]``, -1 for the world."""
        owner = np.full(self.world.model.nbody, -1)
        for i, entity in enumerate(self.compiled.layout.entities):
            owner[[body for body in self.world.bodies.get(entity.name, ()) if body]] = i
        return owner

    def dof(self, dof: int) -> int:
        """Velocity coordinate of the model behind one of the layout's."""
        layout = self.compiled.layout
        joint = int(np.flatnonzero(layout.joint_qd_start <= dof)[-1])
        return int(self.world.joint_qd[joint]) + dof - int(layout.joint_qd_start[joint])

    def asset_key(self, name: str) -> str:
        """Key of the robot that a body, joint or actuator belongs to, by the name it begins with."""
        robots = [robot.name for robot in self.scene.robot]
        found = next((robot for robot in robots if name.startswith(f"{robot}/")), robots[0] if robots else "")
        return f"robot.{found}"
