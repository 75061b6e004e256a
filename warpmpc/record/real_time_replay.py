# SPDX-License-Identifier: Apache-2.0
"""A logged run in real time once more: the same observations must give the same plans, and these the same commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..controller.controller import Controller
from ..model.compiled import compile_scene
from ..realtime.agent import Agent
from ..realtime.letters import TimedPlan
from ..realtime.planning import Planning
from .replay import Replay, differences, scene_of

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..realtime.real_time_log import RealTimeLog
    from ..scene.schema import Scene
    from .history import History


@dataclass(frozen=True, kw_only=True)
class RealTimeReplay:
    """What planning and commanding again came to."""

    plans: Replay
    """Knots of the plans and when they stand, a row for each plan."""
    commands: Replay
    """What the agent sent, a row for each tick; NaN where it sent nothing."""
    unknown: int
    """Ticks whose newest plan is not in the log, so that their commands can hardly be the same."""

    @property
    def same(self) -> bool:
        """Whether all plans and all commands are the logged ones, bit for bit."""
        return self.plans.same and self.commands.same


def replay_real_time(history: History, *, terms: Sequence[UserTerm] = ()) -> RealTimeReplay:
    """Plan again from what a planner in real time was told, and command again what an agent did.

    A planner that died is followed by another one, as then. The agent is that of the scene, from its first tick on, in
    one ``RobotLoop.run``. What :func:`warpmpc.replay` says of cost terms that search beside the plans holds here, too.

    Args:
        history: The run (``TickRecorder.history`` with ``planner.log``).
        terms: Users' own cost terms and ancillary controllers that the scene names.

    Raises:
        SceneError: If the scene is none of this warpmpc, or its files are not here.
        ValueError: If the history has no log of plans in real time, or the engine or device is not to be had here.
    """
    made, ticks = history.made, history.ticks
    if made is None or ticks is None or ticks.now is None:
        raise ValueError("the history has no log of what plans in real time were made from")
    about = made.origin
    scene = scene_of(about)
    timed, names = _plan_again(scene, made, terms)
    found = np.array([_numbers(t.plan.times, t.plan.knots) for t in timed])
    logged = np.array([_numbers(*row) for row in zip(made.knot_time, made.knots, strict=True)])
    said, (count, size, _) = tuple(differences(about)), made.knots.shape
    knots = [f"time of knot {p}" for p in range(size)] + [f"{name} at knot {p}" for p in range(size) for name in names]
    rows = made.rows(ticks.plan)
    return RealTimeReplay(
        plans=Replay(
            logged=logged.reshape(count, len(knots)),
            found=found.reshape(count, len(knots)),
            time=made.time,
            control_names=tuple(knots),
            differences=said,
            what="plan",
        ),
        commands=Replay(
            logged=history.control,
            found=_command_again(scene, history, timed, rows),
            time=ticks.now,
            control_names=tuple(names),
            differences=said,
        ),
        unknown=int(((rows < 0) & (ticks.plan >= 0)).sum()),
    )


def _plan_again(scene: Scene, made: RealTimeLog, terms: Sequence[UserTerm]) -> tuple[list[TimedPlan], Sequence[str]]:
    """All plans once more, with what only the log knows of them, and the names of the controls."""
    about: dict[str, Any] = made.origin
    found: list[TimedPlan] = []
    life, planning, controller = -1, None, None
    for n in range(len(made)):
        if made.life[n] != life:
            life = made.life[n]
            choice = {key: about[key] for key in ("engine", "device", "strategy", "seed")}
            controller = Controller(scene, **choice, terms=terms)
            planning = Planning(controller, number=int(made.number[n]))
        limits = made.lower[n], made.upper[n]
        if not all(map(np.array_equal, limits, controller.limits)):
            controller.set_limits(*limits)
        timed = planning.plan(made.sighting(n), reach=float(made.reach[n]))
        found.append(replace(timed, latency=float(made.latency[n]), plan_ms=float(made.plan_ms[n])))
    names = controller.layout.control_name if controller is not None else ()
    return found, names


def _command_again(scene: Scene, history: History, timed: list[TimedPlan], rows: np.ndarray) -> np.ndarray:
    """What the agent sends when it sees the same and has the same plans ``[N, nu]``."""
    ticks = history.ticks
    found = np.full(history.control.shape, np.nan)
    if not len(found):
        return found
    agent = Agent(scene, compile_scene(scene).layout)
    for n, row in enumerate(rows):
        control = agent.command(ticks.state(n), None if row < 0 else timed[row], float(ticks.now[n]))
        if control is not None:
            found[n] = control
    return found


def _numbers(times: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Times and knots of a plan side by side, exactly."""
    return np.concatenate([times, np.ravel(knots)], dtype=float)
