# SPDX-License-Identifier: Apache-2.0
"""Users' cost terms tried before any plan: compiled, and evaluated at the start and at states near it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..compiling import native_output
from ..kernels.geometry.kinematics import BALL, DISTANCE, FREE
from ..model.batch_size import BatchSize
from ..model.trajectory import Trajectory
from ..task.observed import ObservedState
from .blame import complaint, raised_at, refused, require_returns
from .deadline import TooLong, deadline
from .interpret import OutOfRange, as_python, watched
from .stack import CostEvaluator, CostStack
from .term import ArrayCost, CostTerm

if TYPE_CHECKING:
    from collections.abc import Collection

    from ..kernels.terms.view import StepView
    from ..model.layout import Layout
    from ..scene.schema import Scene

SAMPLES, STEPS = 4, 2
"""Rollouts of an environment, the first of which stays at the start, and their steps."""
LONGEST = 5.0
"""Longest time of a term in Python for one step of one world [s]: far longer than any that a plan could wait for."""
LONGEST_FIRST = 60.0
"""Longest time of a term over whole arrays [s]: its first call may import or compile what it computes with."""


def try_terms(stack: CostStack, scene: Scene) -> None:
    """Compile and evaluate users' terms, no physics needed.

    Args:
        stack: All terms, bound.
        scene: The scene.

    Raises:
        SceneError: If one cannot be compiled, raises, does not end, reads behind the end of what a step has to show,
            returns anything but numbers or is not finite at the start; it names the user's file and line.
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
    trajectory = _near_start(stack, shape)
    step_end = scene.timing.control_dt * np.arange(STEPS + 1)
    evaluator = CostEvaluator(stack, trajectory, trajectory.control, state, shape, step_end)
    _watch_indices(stack, scene, evaluator.view, users)
    _launch(stack, scene, evaluator, users)
    for i in users:
        term, label = stack.terms[i][0], stack.labels[i]
        if isinstance(term, ArrayCost):
            evaluator.evaluate_array(i, longest=LONGEST_FIRST)
        value = evaluator.cost.numpy()[i]
        if not np.isfinite(value[:, :: shape.rollouts]).all():
            found = "NaN" if np.isnan(value[:, :: shape.rollouts]).any() else "infinite"
            raise complaint(label, term, f"the cost is {found} at the start state", file=scene.path)


def _near_start(stack: CostStack, shape: BatchSize) -> Trajectory:
    """Rollouts that begin at the start and go on at random; every environment's first one stays there."""
    layout, rng = stack.layout, np.random.default_rng(0)
    out = Trajectory.allocate(shape, layout, len(stack.pairs), stack.device)
    moving = (np.arange(shape.worlds) % shape.rollouts > 0)[None, :, None] * np.arange(shape.horizon + 1)[:, None, None]

    def spread(width: int, size: float) -> np.ndarray:
        return size * moving * rng.normal(size=(shape.horizon + 1, shape.worlds, width))

    out.joint_q.assign(_valid(layout, layout.joint_q + spread(layout.nq, 0.05)).astype(np.float32))
    out.joint_qd.assign((layout.joint_qd + spread(layout.nv, 0.1)).astype(np.float32))
    out.sensor.assign(spread(layout.ns, 0.1)[1:].astype(np.float32))
    middle, half = (
        0.5 * (layout.control_lower + layout.control_upper),
        0.5 * (layout.control_upper - layout.control_lower),
    )
    share = rng.uniform(-1.0, 1.0, size=out.control.shape) * (moving[1:] > 0)
    out.control.assign(np.nan_to_num(middle + share * half, posinf=0.0, neginf=0.0).astype(np.float32))
    stack.kinematics(out.joint_q, out.joint_qd, out.body_q, out.body_qd)
    return out


def _valid(layout: Layout, q: np.ndarray) -> np.ndarray:
    """Joint coordinates ``[..., nq]`` whose quaternions are of length one."""
    for kind, start in zip(layout.joint_type, layout.joint_q_start, strict=True):
        if kind in (int(FREE), int(DISTANCE), int(BALL)):
            i = int(start) + (0 if kind == int(BALL) else 3)
            q[..., i : i + 4] /= np.linalg.norm(q[..., i : i + 4], axis=-1, keepdims=True)
    return q


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


def _watch_indices(stack: CostStack, scene: Scene, step: StepView, users: Collection[int]) -> None:
    """Run users' functions in Python at every step of the first environment."""
    seen = watched(step)
    for i in users:
        term, params = stack.terms[i]
        if not isinstance(term, CostTerm):
            continue
        for function, first in ((term.advance, 0), (term.function, 1)):
            run = None if function is None else as_python(function)
            if run is None:
                continue
            try:
                for w in range(SAMPLES):
                    for t in range(first, STEPS + 1):
                        seen.t, seen.w, seen.e = t, w, 0
                        with deadline(LONGEST):
                            run(seen, params)
            except (OutOfRange, TooLong) as error:
                where = raised_at(error, (term.written or function).func)
                raise complaint(stack.labels[i], term, str(error), file=scene.path, where=where) from None
            except Exception:  # something that Python does not know how to do: the kernel will tell
                continue
