# SPDX-License-Identifier: Apache-2.0
"""Planning again what was logged: the same scene, seed and observations must give the same plans and commands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...loop.realtime.agent import Agent
from ...loop.realtime.messages import TimedObservation, TimedPlan
from ...loop.realtime.planning import Planning
from ...planner.controller.controller import Controller
from ...scene.load import parse_scene
from ...scene.model.compiled import compile_scene
from ...scene.origin import origin

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...loop.log.run_log import RunLog
    from ...scene.schema import Scene


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Rows of numbers as they were logged and as they are now."""

    what: str
    """Kind of a row: a command or a plan."""
    logged: np.ndarray
    """Numbers of the log ``[N, n]``; NaN where nothing was sent."""
    found: np.ndarray
    """The same now ``[N, n]``."""
    time: np.ndarray
    """Times of the rows ``[N]`` [s]."""
    names: Sequence[str]
    """Names of the numbers ``[n]``."""

    @property
    def agree(self) -> np.ndarray:
        """Return whether each row is the logged one, bit for bit ``[N]``."""
        return ~self._differs.any(axis=1)

    @property
    def _differs(self) -> np.ndarray:
        """Return whether bits of each number differ ``[N, n]``."""
        kind = np.dtype(f"u{self.logged.itemsize}")
        return self.logged.view(kind) != self.found.view(kind)

    @property
    def same(self) -> bool:
        """Return whether all of them are."""
        return bool(self.agree.all())

    @property
    def first(self) -> str | None:
        """A sentence on the first number that differs, None where none does."""
        if self.same:
            return None
        n = int(np.argmin(self.agree))
        i = int(np.argmax(self._differs[n]))
        logged, found = self.logged[n, i], self.found[n, i]
        return f"{self.what} {n} at t = {self.time[n]:.3f} s: {self.names[i]} was {logged:.9g}, now it is {found:.9g}"


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Result of planning and commanding again."""

    commands: Comparison
    """Commands of the controller; in real time those of the agent, a row for each tick."""
    differences: tuple[str, ...]
    """Versions, source and hardware that are not as they were. Then the bits may differ."""
    plans: Comparison | None = None
    """In real time: knots of the plans and their times, a row for each plan."""
    unknown: int = 0
    """Ticks whose newest plan is not in the log, so that their commands can hardly be the same."""

    @property
    def parts(self) -> list[Comparison]:
        """Comparisons, plans before commands."""
        return [part for part in (self.plans, self.commands) if part is not None]

    @property
    def same(self) -> bool:
        """Return whether all plans and all commands are the logged ones, bit for bit."""
        return all(part.same for part in self.parts)

    @property
    def first(self) -> str | None:
        """A sentence on the first number that differs, None where none does."""
        return next((part.first for part in self.parts if not part.same), None)


def replay(log: RunLog, *, terms: Sequence[UserTerm] = ()) -> Replay:
    """Plan again from logged observations, with a fresh controller.

    In real time a planner that died is followed by another one, as then, and an agent, that of the scene, commands
    again what it saw, from its first tick on, in one ``RobotLoop.run``. What cost terms search beside the plans (the
    paths of ``push_path`` after the goal was moved) is ready when it is ready, which no log can tell: plans in between
    may differ. So do those after a ``Controller.reset`` in the middle.

    Args:
        log: The log.
        terms: Users' own cost terms and ancillary controllers that the scene names.

    Raises:
        SceneError: If this version of warpmpc cannot read the scene, or its files are not here.
        ValueError: If the log has no plans or does not begin with the first, or the engine or device is not available
            here.
    """
    require_plans(log)
    scene = logged_scene(log)
    return _replay_real_time(log, scene, terms) if log.real_time else _replay_closed_loop(log, scene, terms)


def require_plans(log: RunLog) -> None:
    """Refuse a log that cannot be replayed.

    Raises:
        ValueError: If it lacks what plans were made from.
    """
    if log.origin is None or "joint_q" not in (log.plans.dtype.names or ()):
        why = "its planner noted nothing"
        raise ValueError(f"has no log of what its plans were made from ({why}): run it again with --npz or --out")


def _controller(log: RunLog, scene: Scene, terms: Sequence[UserTerm]) -> Controller:
    choice = {key: log.origin[key] for key in ("engine", "device", "strategy", "seed")}
    return Controller(scene, **choice, terms=terms)


def _limit(controller: Controller, plan: np.record) -> None:
    limits = plan.lower, plan.upper
    if not all(map(np.array_equal, limits, controller.limits)):
        controller.set_limits(*limits)


def _replay_closed_loop(log: RunLog, scene: Scene, terms: Sequence[UserTerm]) -> Replay:
    if not log.origin["from_start"]:
        raise ValueError("the log does not begin with its controller's first plan: what that one had learned is lost")
    controller, clouds = _controller(log, scene, terms), log.points()
    logged = np.ascontiguousarray(log.plans.command)
    found = np.zeros_like(logged)
    for n, plan in enumerate(log.plans):
        controller.task.follow(plan.task)
        for name, points in clouds.items():
            if n in points:
                controller.task.see(name, points[n])
        _limit(controller, plan)
        found[n] = controller.step(log.observed(n))
    names = list(controller.layout.control_name)
    commands = Comparison(what="command", logged=logged, found=found, time=log.plans.time, names=names)
    return Replay(commands=commands, differences=tuple(differences(log.origin)))


def _replay_real_time(log: RunLog, scene: Scene, terms: Sequence[UserTerm]) -> Replay:
    timed = list(_plan_again(log, scene, terms))
    plans, names, size = log.plans, log.names["controls"], log.plans.knots.shape[1]
    knots = [f"time of knot {p}" for p in range(size)] + [f"{name} at knot {p}" for p in range(size) for name in names]
    rows = log.plan_rows()
    return Replay(
        plans=Comparison(
            what="plan",
            logged=np.array([_numbers(p.knot_time, p.knots) for p in plans]).reshape(-1, len(knots)),
            found=np.array([_numbers(t.plan.times, t.plan.knots) for t in timed]).reshape(-1, len(knots)),
            time=plans.time,
            names=knots,
        ),
        commands=Comparison(
            what="command",
            logged=np.ascontiguousarray(log.controls.control),
            found=_command_again(log, scene, timed, rows),
            time=log.controls.clock,
            names=names,
        ),
        unknown=int(((rows < 0) & (log.controls.plan >= 0)).sum()),
        differences=tuple(differences(log.origin)),
    )


def _plan_again(log: RunLog, scene: Scene, terms: Sequence[UserTerm]) -> Iterator[TimedPlan]:
    """All plans once more, with what only the log knows of them."""
    life, planning = -1, None
    for n, plan in enumerate(log.plans):
        if plan.life != life:
            life, planning = plan.life, Planning(_controller(log, scene, terms), number=int(plan.number))
        _limit(planning.controller, plan)
        timed = planning.plan(logged_observation(log, n), reach=float(plan.reach))
        yield replace(timed, latency=float(plan.latency), plan_ms=float(plan.plan_ms))


def logged_observation(log: RunLog, n: int) -> TimedObservation:
    """Observation that a planner in real time was told before plan n."""
    plan, state = log.plans[n], log.observed(n)
    act, mocap = (None if np.isnan(part).any() else part for part in (state.act, state.mocap))
    return TimedObservation(replace(state, act=act, mocap=mocap), plan.sent, bool(plan.following), plan.task)


def _command_again(log: RunLog, scene: Scene, timed: list[TimedPlan], rows: np.ndarray) -> np.ndarray:
    """Commands of an agent that sees the same and has the same plans ``[N, nu]``."""
    found = np.full(log.controls.control.shape, np.nan)
    if not len(found):
        return found
    agent = Agent(scene, compile_scene(scene).layout)
    for n, row in enumerate(rows):
        control = agent.command(log.seen(n), None if row < 0 else timed[row], float(log.controls.clock[n]))
        if control is not None:
            found[n] = control
    return found


def _numbers(times: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Times and knots of a plan side by side, exactly."""
    return np.concatenate([times, np.ravel(knots)], dtype=float)


def logged_scene(log: RunLog) -> Scene:
    """The scene that a log's plans were made for.

    Raises:
        SceneError: If this version of warpmpc cannot read it.
    """
    about = log.origin
    path = about["file"] and Path(about["file"])
    return parse_scene(about["text"], path=path, variant=about["variant"])


def differences(about: Mapping[str, Any]) -> Iterator[str]:
    """Yield what of a log's origin is otherwise here, as ``what: then, now``."""
    here = origin()
    for name in ("versions", "hardware"):
        for key, value in here[name].items():
            then = about[name].get(key)
            if then != value:
                yield f"{key}: {_joined(then)}, now {_joined(value)}"
    if about["code"] != here["code"]:
        then, now = (f"{o['code']} ({o['revision']})" if o["revision"] else o["code"] for o in (about, here))
        yield f"source of warpmpc: {then}, now {now}"


def _joined(value: object) -> str:
    return ", ".join(map(str, value)) or "none" if isinstance(value, list) else str(value)
