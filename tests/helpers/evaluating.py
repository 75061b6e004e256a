# SPDX-License-Identifier: Apache-2.0
"""Cost terms of a scene over rollouts that are put in place by hand."""

from __future__ import annotations

import numpy as np
from small_scenes import layout_of

from warpmpc import Scene, Task
from warpmpc.cost.stack import CostEvaluator, CostStack
from warpmpc.cost.trial import try_terms
from warpmpc.engine.protocol import TimeGrid
from warpmpc.scene.model.layout import Layout
from warpmpc.scene.model.trajectory import BatchSize, Trajectory
from warpmpc.scene.task.observed import ObservedState


class Evaluating:
    """The terms of a scene, bound, with rollouts of zeros to evaluate and a task to change."""

    def __init__(self, scene: Scene, shape: BatchSize, *, terms=(), device: str = "cpu", layout: Layout | None = None):
        self.scene, self.shape, self.device = scene, shape, device
        self.layout = layout_of(scene) if layout is None else layout
        self.task = Task(scene, envs=shape.envs)
        self.stack = CostStack(scene, self.layout, self.task, terms=terms, device=device)
        try_terms(self.stack, scene)
        self.trajectory = Trajectory.allocate(shape, self.layout, len(self.stack.pairs), device)
        self.control = self.trajectory.control
        self.state = ObservedState.allocate(self.layout, self.task, device)
        first = 7 * len(self.task.pose_name)
        self.state.scalar.assign(self.task.block[:, first : first + len(self.task.scalar_name)])
        self.evaluator = self.evaluator_of(self.stack)

    def evaluator_of(self, stack: CostStack) -> CostEvaluator:
        """An evaluator of the same rollouts with the terms of a stack."""
        step_end = TimeGrid.of(self.scene).t[: self.shape.horizon + 1]
        return CostEvaluator(stack, self.trajectory, self.control, self.state, self.shape, step_end)

    def set_goal(self, poses: np.ndarray) -> None:
        """Move the goals [E, 7], and wait for everything that follows them."""
        self.task["goal"] = poses
        self.state.pose.assign(self.task.block[:, : 7 * len(self.task.pose_name)].reshape(len(poses), -1, 7))
        for resource in self.stack.resources:
            resource.settle()

    def observe(self) -> None:
        """Bring the resources up to date with the first slice of the rollouts, of each environment's first world."""
        body_q = self.trajectory.body_q.numpy()[0, :: self.shape.rollouts]
        self.state.body_q.assign(body_q)
        self.stack.refresh()
        for resource in self.stack.resources:
            resource.before_plan(self.state)

    def cost(self) -> np.ndarray:
        """Weighted cost of every term, step and world ``[term, T, W]``."""
        self.evaluator.launch()
        self.evaluator.launch_arrays()
        return self.evaluator.cost.numpy().astype(np.float64)
