# SPDX-License-Identifier: Apache-2.0
"""Demonstrations: what a planner saw and what it did, from a run log."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..record.replay import logged_scene, require_plans
from ..task.task import Task

if TYPE_CHECKING:
    from ..log.run_log import RunLog

ENDLESS = ("timeout", "interrupted")
"""Reasons for which an episode ends although its task could go on."""


@dataclass(frozen=True, kw_only=True)
class Demonstration:
    """One episode of N controls, in float32 as a planner has it."""

    observations: dict[str, np.ndarray]
    """What was observed before each control, by name, ``[N + 1, n]``: ``joint_q``, ``joint_qd``, ``act``, ``mocap``,
    and poses (x, y, z, qx, qy, qz, qw) and scalars of the task, as ``planner.ancillary.observation`` names them. The
    last row is the true state at the end, with activations, mocap poses and the task as they were before it."""
    actions: np.ndarray
    """Controls that were applied ``[N, nu]``, in the units of the drives."""
    time: np.ndarray
    """Times of the states ``[N + 1]`` [s]."""
    limits: np.ndarray
    """Lower and upper limits of the controls ``[2, nu]``, those of the last plan."""
    names: dict[str, list[str]]
    """Names of the numbers of ``joint_q``, ``joint_qd`` and ``controls``."""
    origin: dict[str, Any]
    """Plain data: scene as text, seed, engine, strategy, versions."""
    success: bool | None = None
    """Whether the goal was reached; None where that is not known."""
    reason: str | None = None
    """Its end in words; None where that is not known."""

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def rewards(self) -> np.ndarray:
        """One for the control that reached the goal, else zero ``[N]``."""
        return np.where(self.ends, 1.0, 0.0).astype(np.float32) * bool(self.success)

    @property
    def ends(self) -> np.ndarray:
        """Return whether each control is the last ``[N]``."""
        return np.arange(1, len(self) + 1) == len(self)

    @property
    def terminated(self) -> bool:
        """Return whether the task itself came to its end, well or badly, not just the time for it."""
        return bool(self.success) or self.reason not in (None, *ENDLESS)


def demonstration(log: RunLog, *, success: bool | None = None, reason: str | None = None) -> Demonstration:
    """Make a demonstration of a run log.

    In real time a step is a tick; those before the first plan, and those at which nothing was sent or nothing finite
    was observed, are left out.

    Args:
        log: The log, with its plans.
        success: Whether the episode reached its goal, None where that is not known.
        reason: Its end in words, None where that is not known.

    Raises:
        SceneError: If the scene is none of this warpmpc.
        ValueError: If the log lacks what its plans were made from, or nothing was sent.
    """
    require_plans(log)
    plan, controls = log.plan_rows(), log.controls
    if log.real_time:
        seen = {"joint_q": controls.seen_q, "joint_qd": controls.seen_qd, "act": controls.seen_act}
        seen["mocap"] = controls.seen_mocap
        finite = [np.isfinite(rows.reshape(len(rows), -1)).all(axis=1) for rows in (*seen.values(), controls.control)]
        kept = np.flatnonzero((plan >= 0) & np.all(finite, axis=0))
    else:
        seen = {name: log.plans[name][plan] for name in ("joint_q", "joint_qd", "act", "mocap")}
        kept = np.arange(len(controls))
    if not len(kept):
        raise ValueError("the log has no control that a plan sent")
    end = log.states[kept[-1] + 1]
    seen = {name: rows[kept].reshape(len(kept), -1) for name, rows in seen.items() if rows.size}
    last = {"joint_q": end.joint_q, "joint_qd": end.joint_qd}
    observations = {name: np.vstack([rows, last.get(name, rows[-1])]) for name, rows in seen.items()}
    observations |= task_values(Task(logged_scene(log)), log.plans.task[plan[[*kept, kept[-1]]]])
    newest = log.plans[plan[kept[-1]]]
    return Demonstration(
        observations={name: rows.astype(np.float32) for name, rows in observations.items()},
        actions=controls.control[kept].astype(np.float32),
        time=log.states.time[[*kept, kept[-1] + 1]],
        limits=np.stack([newest.lower, newest.upper]),
        names={name: list(log.names[name]) for name in ("joint_q", "joint_qd", "controls")},
        origin=log.origin,
        success=success,
        reason=reason,
    )


def task_values(task: Task, block: np.ndarray) -> dict[str, np.ndarray]:
    """Poses and scalars of a task by name ``[N, 7]`` and ``[N, 1]``.

    Args:
        task: A task of the same scene; it is changed.
        block: Its rows of values ``[N, ...]`` (``Task.block``).
    """
    rows, which = np.unique(block, axis=0, return_inverse=True)
    values: list[dict[str, np.ndarray | float]] = []
    for row in rows:
        task.follow(row)
        values.append(task.values())
    named = {name: np.stack([np.atleast_1d(value[name]) for value in values]) for name in task.values()}
    return {name: found[which] for name, found in named.items()}
