# SPDX-License-Identifier: Apache-2.0
"""Values of cost terms in the present state of simulated plants, for success tests and phases."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..scene.schema import When
from ..scene.task.observed import ObservedState
from .stack import CostEvaluator, CostStack

if TYPE_CHECKING:
    from ..scene.model.layout import Layout
    from ..scene.model.trajectory import BatchSize, Trajectory
    from ..scene.schema import Scene
    from ..scene.task.task import Task
    from .term import UserTerm


class TermValues:
    """Evaluates some cost terms of a scene without their weights, one world per environment.

    Args:
        scene: The scene.
        layout: Its layout, targets included.
        task: The task.
        labels: Which terms.
        terms: Users' own terms.

    Raises:
        SceneError: If a term, one of its keys, or a frame or entity they name does not exist.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        task: Task,
        labels: Collection[str],
        *,
        terms: Sequence[UserTerm] = (),
    ):
        costs = [
            cost.model_copy(update={"terminal": 1.0, "when": When.STAGE})  # a condition is about the value itself
            for label, cost in zip(scene.cost_labels, scene.cost, strict=True)
            if label in labels
        ]
        self._labels = [label for label in scene.cost_labels if label in labels]
        self._stack = CostStack(scene, layout, task, terms=terms, costs=costs)
        self._state = ObservedState.allocate(layout, task, "cpu")
        self._state.weight.fill_(1.0)
        self._task = task
        self._evaluator: CostEvaluator | None = None
        self.pairs = self._stack.pairs
        """Contacts that the terms watch; the trajectory's first ones."""
        self.sensors = self._stack.sensors
        """Sensors that the terms read."""

    def attach(self, trajectory: Trajectory, control: wp.array, shape: BatchSize, dt: float) -> None:
        """Read these one-step trajectories from now on.

        Args:
            trajectory: Trajectories ``[2, E, ...]``.
            control: Controls ``[1, E, nu]`` that led to their last state.
            shape: One sample and one step for each of E environments.
            dt: Length of that step [s].
        """
        self._trajectory, self._control = trajectory, control
        self._before = control.numpy()[0].copy()
        self._evaluator = CostEvaluator(self._stack, trajectory, control, self._state, shape, np.array([0.0, dt]))

    def __call__(self, times: Sequence[float]) -> list[dict[str, float]]:
        """Value of every term after the last control, by environment.

        Args:
            times: When that control began ``[E]`` [s].
        """
        state, task, out = self._state, self._task, self._trajectory
        envs, poses = task.envs, len(task.pose_name)
        state.pose.assign(task.block[:, : 7 * poses].reshape(envs, poses, 7))
        state.scalar.assign(task.block[:, 7 * poses : 7 * poses + len(task.scalar_name)])
        state.joint_q.assign(out.joint_q.numpy()[-1])
        state.joint_qd.assign(out.joint_qd.numpy()[-1])
        state.start.assign(np.array(times, dtype=np.float32))
        state.last_control.assign(self._before)
        self._before = self._control.numpy()[0].copy()
        self._stack.refresh()
        self._stack.before_plan(state)
        self._evaluator.launch()
        self._evaluator.launch_arrays()
        values = self._evaluator.cost.numpy()[:, 0]
        return [dict(zip(self._labels, map(float, values[:, e]), strict=True)) for e in range(envs)]
