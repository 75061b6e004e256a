# SPDX-License-Identifier: Apache-2.0
"""Notes of plans for the run log: what each was made from and what it came to.

Provenance of a controller's plans, as plain data.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...scene.load import dump_scene
from ...scene.model.state import PROPOSERS
from ...scene.origin import origin
from ..log.writer import RunLogWriter, row_type

if TYPE_CHECKING:
    from ...planner.controller.controller import Controller
    from ...scene.model.state import State
    from .messages import TimedObservation, TimedPlan


def provenance(controller: Controller) -> dict[str, Any]:
    """Plain data for JSON: scene as text, seed, engine, device, strategy; versions, source and hardware."""
    scene = controller.scene
    about = {
        "scene": scene.name,
        "variant": scene.variant,
        "file": None if scene.path is None else str(scene.path),
        "text": dump_scene(scene),
        "seed": controller.seed,
        "engine": controller.engine.name,
        "device": controller.device,
        "strategy": controller.strategy,
        "samples": controller.shape.samples,
    }
    return {**about, **origin()}


INPUTS = ("number", "time", "joint_q", "joint_qd", "act", "mocap", "task", "lower", "upper")
OUTCOME = ("cost", "terms", "beta", "eta", "proposer", "lowered")
CLOSED_LOOP = (*INPUTS, *OUTCOME, "command", "knot_time", "knots")
"""Columns of plans that a closed loop makes."""
REAL_TIME = (
    *INPUTS,
    *OUTCOME,
    *("life", "sent", "following", "reach", "latency", "plan_ms", "survived", "knot_time", "knots"),
)
"""Columns of plans that are made in real time."""


def sizes(controller: Controller) -> dict[str, int]:
    """Sizes of the axes of ``plans`` by name."""
    layout = controller.layout
    found = {name: getattr(layout, name) for name in ("nq", "nv", "na", "nm", "nu")}
    terms, knots, task = (
        len(controller.costs.labels),
        len(controller.plan_step.plan_spline.times),
        controller.task.block.shape[1],
    )
    return {**found, "terms": terms, "knots": knots, "task": task}


def plan_columns(controller: Controller, state: State) -> dict[str, Any]:
    """Columns of the newest plan of a controller of one environment.

    Args:
        controller: The controller.
        state: What it observed.
    """
    info, (lower, upper) = controller.info, controller.limits
    missing = np.nan  # left out
    return {
        "time": state.time,
        "joint_q": state.joint_q,
        "joint_qd": state.joint_qd,
        "act": missing if state.act is None else state.act,
        "mocap": missing if state.mocap is None else state.mocap,
        "task": controller.planned_task[0],
        "lower": lower,
        "upper": upper,
        "cost": info.cost,
        "terms": list(info.terms.values()),
        "beta": info.beta,
        "eta": info.eta,
        "proposer": PROPOSERS.index(info.proposer),
        "lowered": info.lowered,
    }


class PlanLogger:
    """Notes plans in real time, in a file beside the run log, from which the end of the process takes nothing.

    Args:
        controller: Makes the plans, of one environment.
        log: The run log.
        life: Planners before this one.
    """

    def __init__(self, controller: Controller, log: Path, life: int = 0):
        self._controller, self._life = controller, life
        kinds = {"plans": row_type("plans", sizes(controller), REAL_TIME)}
        names = {"terms": list(controller.costs.labels)}
        path = log.with_name(f"{log.name}.{life}")
        self._writer = RunLogWriter(path, kinds, names=names, origin=provenance(controller))

    def note(self, observation: TimedObservation, reach: float, timed: TimedPlan) -> None:
        """Note the newest plan.

        Args:
            observation: What it was made from.
            reach: How far that was predicted forward [s].
            timed: The plan.
        """
        plan = timed.plan
        self._writer.add(
            "plans",
            **plan_columns(self._controller, observation.state),
            life=self._life,
            number=timed.number,
            sent=observation.command,
            following=observation.following,
            reach=reach,
            latency=timed.latency,
            plan_ms=timed.plan_ms,
            survived=timed.survived,
            knot_time=plan.times,
            knots=plan.knots,
        )

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
