# SPDX-License-Identifier: Apache-2.0
"""A plan step on a real small scene."""

from __future__ import annotations

import numpy as np
from small_scenes import compiled, layout_of, make_scene

from warpmpc import Task
from warpmpc.cost.stack import CostStack
from warpmpc.planner.step import PlanStep
from warpmpc.scene.model.properties import draw_properties
from warpmpc.scene.model.trajectory import BatchSize

PLANNER = {"samples": 48, "horizon": 8, "noise": {"sigma": (0.5,)}}


def limited_mean(drawn, weight, mean, limits, *, alpha: float, variance) -> np.ndarray:
    """What a mean [E, P, nu] becomes where samples [E, S, P, nu] may be outside limits [nu], in float64."""
    tried = len(variance)
    others = drawn[:, :tried][:, variance > 0.0]
    share = weight[:, :tried] / weight[:, :tried].sum(axis=1, keepdims=True)
    step = np.einsum("es,espu->epu", share, drawn[:, :tried]) - mean
    factor = (1.0 - np.square(share).sum(axis=1)) * (share @ variance) / variance.sum()
    noise = factor[:, None, None] * (others - mean[:, None]).sum(axis=1)
    met = np.any((others < limits[0]) | (others > limits[1]), axis=1)
    return np.clip(mean + alpha * (step - np.where(met, noise, 0.0)), *limits)


class Planning:
    """A plan step of the disc that drives to (1, 0.5), away from any controller."""

    def __init__(self, *, seed: int = 0, envs: int = 1, **sections):
        planner = {**PLANNER, **sections.pop("planner", {})}
        scene = make_scene(planner=planner, **sections)
        self.scene, self.layout = scene, layout_of(scene)
        planner = scene.planner
        shape = BatchSize(envs, planner.samples, planner.domains, planner.horizon)
        draws = planner.domains if planner.domains > 1 else planner.samples
        self.costs = CostStack(scene, self.layout, Task(scene, envs=envs))
        properties = draw_properties(scene, self.layout, draws, seed=seed)
        self.plan = PlanStep(
            scene, compiled(scene), self.costs, shape, engine="mujoco", seed=seed, properties=properties
        )
        self.engine, self.strategy = self.plan.engine, self.plan.strategy
        self.q, self.qd = (np.tile(a, (envs, 1)) for a in (self.layout.joint_q, self.layout.joint_qd))
        self.elapsed = scene.timing.control_dt  # between plans

    def __call__(self, steps: int = 1) -> np.ndarray:
        """Plan again and again from the same state, a control apart; returns the commands ``[steps, E, nu]``."""
        out = []
        self.costs.refresh()
        for _ in range(steps):
            self.plan.state.joint_q.assign(self.q)
            self.plan.state.joint_qd.assign(self.qd)
            self.plan.state.elapsed.fill_(self.elapsed)
            self.plan()
            out.append(self.plan.command.numpy().copy())
        return np.array(out)

    @property
    def cost(self) -> np.ndarray:
        """Costs of all samples ``[E, S]``."""
        return self.engine.cost.numpy()

    @property
    def mean(self) -> np.ndarray:
        """Knots of the plan ``[E, P, nu]``, a copy."""
        return self.strategy.mean.numpy().copy()

    @property
    def knots(self) -> np.ndarray:
        """Sampled knots ``[E, S, P, nu]``, a copy."""
        return self.strategy.knots.numpy().copy()

    @property
    def noise(self) -> np.ndarray:
        """Shaped noise of the samples ``[E, S, P, nu]``, of unit variance, a copy."""
        return self.strategy.noise.noise.numpy().reshape(self.strategy.knots.shape).copy()

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits of the controls, ``[nu]`` each."""
        return self.layout.control_lower, self.layout.control_upper

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations ``[E, P, nu]``, a copy."""
        return self.strategy.distribution.sigma.numpy().copy()
