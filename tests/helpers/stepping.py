# SPDX-License-Identifier: Apache-2.0
"""Differences along short rollouts, for tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpmpc import Controller, Scene
from warpmpc.engine.registry import EngineRequest, PhysicsSteps, physics_steps
from warpmpc.physics.tangent import Tangent
from warpmpc.planner.derivatives.expansion import Differences
from warpmpc.planner.derivatives.residuals import Residuals
from warpmpc.planner.derivatives.rollouts import PolicyRollouts


@dataclass
class Stepping:
    """What differences are taken of."""

    controller: Controller
    request: EngineRequest
    steps: PhysicsSteps
    residuals: Residuals
    rollouts: PolicyRollouts
    differences: Differences

    @property
    def model(self):
        """MuJoCo's model."""
        return self.rollouts.worlds.model

    @property
    def tangent(self) -> Tangent:
        """Where its states are subtracted."""
        return self.rollouts.tangent

    def ctrl(self, control: np.ndarray) -> np.ndarray:
        """What the model's actuators get for controls, and how it changes with them."""
        world = self.rollouts.worlds.world
        return world.actuator_matrix @ control + world.actuator_offset, world.actuator_matrix


def stepping(
    scene: Scene, engine: str = "mujoco", *, candidates: int = 3, envs: int = 1, device: str = "cpu"
) -> Stepping:
    """Everything that derivatives of a scene take."""
    controller = Controller(scene, engine=engine, device=device, envs=envs)
    plan = controller.plan_step
    request = EngineRequest(
        scene=scene,
        compiled=controller.compiled,
        shape=controller.shape,
        grid=plan.grid,
        spline=plan.sampled.table(float(plan.grid.dt[0]), device),
        limits=plan.limits,
        state=plan.state,
        costs=controller.costs,
        device=controller.plan_step.device,
    )
    steps = physics_steps(engine, scene, controller.compiled, plan.grid)
    residuals = Residuals(controller.costs)
    rollouts = PolicyRollouts(controller.engine, request, steps, residuals, candidates)
    differences = Differences(controller.engine, request, steps, residuals, rollouts.tangent)
    return Stepping(controller, request, steps, residuals, rollouts, differences)
