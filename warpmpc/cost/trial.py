# SPDX-License-Identifier: Apache-2.0
"""Users' cost terms tried before any plan: compiled, and evaluated at the start."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..physics.runtime.compiling import native_output
from ..scene.model.trajectory import BatchSize, Trajectory
from ..scene.task.observed import ObservedState
from .stack import CostEvaluator, CostStack
from .term import ArrayCost, CostTerm
from .user_files import complaint, refused, require_returns

if TYPE_CHECKING:
    from collections.abc import Collection

    from ..scene.schema import Scene

SAMPLES, STEPS = 4, 2
"""Rollouts of an environment, and their steps."""


def try_terms(stack: CostStack, scene: Scene) -> None:
    """Compile and evaluate users' terms, no physics needed.

    Args:
        stack: All terms, bound.
        scene: The scene.

    Raises:
        SceneError: If one cannot be compiled, raises, returns anything but numbers or is not finite at the start; it
            names the user's file and line.
    """
    users = stack.users
    if not users:
        return
    for i in users:
        term, label = stack.terms[i][0], stack.labels[i]
        if isinstance(term, CostTerm):
            require_returns(label, term, file=scene.path)
    shape = BatchSize(stack.task.envs, SAMPLES, 1, STEPS)
    layout, device = stack.layout, stack.device
    state = ObservedState.allocate(layout, stack.task, device)
    state.weight.fill_(1.0)
    trajectory = _at_start(stack, shape)
    step_end = scene.timing.control_dt * np.arange(STEPS + 1)
    evaluator = CostEvaluator(stack, trajectory, trajectory.control, state, shape, step_end)
    _launch(stack, scene, evaluator, users)
    for i in users:
        term, label = stack.terms[i][0], stack.labels[i]
        if isinstance(term, ArrayCost):
            evaluator.evaluate_array(i)
        value = evaluator.cost.numpy()[i]
        if not np.isfinite(value).all():
            found = "NaN" if np.isnan(value).any() else "infinite"
            raise complaint(label, term, f"the cost is {found} at the start state", file=scene.path)


def _at_start(stack: CostStack, shape: BatchSize) -> Trajectory:
    """Rollouts that stay at the start, with controls in the middle of their ranges."""
    layout, out = stack.layout, Trajectory.allocate(shape, stack.layout, len(stack.pairs), stack.device)
    middle = np.nan_to_num(0.5 * (layout.control_lower + layout.control_upper), posinf=0.0, neginf=0.0)
    for array, row in ((out.joint_q, layout.joint_q), (out.joint_qd, layout.joint_qd), (out.control, middle)):
        array.assign(np.broadcast_to(row, array.shape).astype(np.float32))
    stack.kinematics(out.joint_q, out.joint_qd, out.body_q, out.body_qd)
    return out


def _launch(stack: CostStack, scene: Scene, evaluator: CostEvaluator, users: Collection[int]) -> None:
    """Compile users' terms that are kernels, without any others, and evaluate them."""
    kernels = [i for i in users if isinstance(stack.terms[i][0], CostTerm)]
    if not kernels:
        return
    code = stack.code_of(kernels)
    said: list[str] = []
    try:
        with native_output() as said:  # a C++ compiler speaks of code that no user has seen
            evaluator.launch(code=code)
    except Exception as error:
        blamed = refused(error, stack.labels, [term for term, _ in stack.terms], file=scene.path)
        if blamed is None:
            i, term = kernels[0], stack.terms[kernels[0]][0]
            why = next((line.partition("error: ")[2] for line in said if "error: " in line), str(error))
            blamed = complaint(stack.labels[i], term, f"Warp cannot compile this: {why}", file=scene.path)
        raise blamed from None
