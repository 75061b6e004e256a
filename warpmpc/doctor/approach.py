# SPDX-License-Identifier: Apache-2.0
"""Samples of a plan: how near they come to what success asks for, and frames that none of them moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..scene.errors import some
from ..task.conditions import StateSnapshot
from .control import PROBES, driven_frames, names_in
from .subject import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..controller.controller import Controller
    from ..controller.rollout import Rollout
    from ..plant.monitor import Monitor
    from ..task.goal import Comparison
    from .subject import Subject

NOISE = 1e-3
"""Share of the way to its bound by which a sample must come nearer than the start, or it counts as no nearer."""
STILL = 1e-4
"""Movement that counts as none [m or rad]."""


@dataclass(frozen=True)
class Approach:
    """A number that success waits for, at the start and where a sample came nearest to its bound."""

    start: Comparison
    best: Comparison

    @property
    def nearer(self) -> bool:
        """True where it holds at the start, or a sample comes nearer to its bound than by noise."""
        return self.start.holds or self.best.excess < self.start.excess - NOISE * abs(self.start.excess)


def probes(controller: Controller) -> list[Rollout]:
    """Rollouts of samples of the last plan that did not diverge; at most ``PROBES``."""
    costs = controller.engine.cost.numpy()[0]
    chosen = np.unique(np.linspace(0, controller.shape.samples - 1, PROBES).astype(int))
    return [controller.rollout(int(k)) for k in chosen if np.isfinite(costs[k])]


def approaches(rollouts: list[Rollout], monitor: Monitor) -> list[Approach]:
    """Conditions of success, or of the end of the first phase, in rollouts; conditions on cost terms are left out."""
    states = [state for rollout in rollouts for state in zip(rollout.body_q, rollout.joint_q, strict=True)]
    compared = (monitor.compared(StateSnapshot(body_q, joint_q, {})) for body_q, joint_q in states)
    found = [Approach(seen[0], min(seen, key=lambda new: new.excess)) for seen in zip(*compared, strict=True)]
    return [approach for approach in found if np.isfinite(approach.start.value)]


def still_findings(subject: Subject, rollouts: list[Rollout]) -> Iterator[Finding]:
    """Frames and joints of driven robots that a term, goal or condition is about and that no sample moves.

    Objects, and what a robot has to touch first, may well stand still in all samples.
    """
    scene, layout = subject.scene, subject.compiled.layout
    if not rollouts:
        return
    poses = np.array([rollout.body_q for rollout in rollouts])
    still = np.ptp(poses, axis=(0, 1)).max(axis=-1) < STILL
    bodies = dict(zip(layout.frame_name, layout.frame_body, strict=True))
    at_rest = {name for name in driven_frames(subject) if still[bodies[name]]} - {robot.name for robot in scene.robot}
    asked = [(f"cost.{cost.name or cost.term}", names_in(cost.params)) for cost in scene.cost]
    if scene.goal is not None:
        asked.append(("goal", {scene.goal.target}))
    asked += [
        ("success.conditions", {condition.frame, condition.to})
        for condition in (scene.success.conditions if scene.success else ())
    ]
    named = {key: sorted(names & at_rest) for key, names in asked if names & at_rest}
    if named:
        (key, names), ahead = next(iter(named.items())), float(np.ptp(rollouts[0].times))
        yield Finding(
            key,
            f"no sample of a plan moves {some(names)} within {ahead:.3g} s",
            "check damping, frictionloss, gains and limits of the joints that carry it, and that nothing holds it",
        )
