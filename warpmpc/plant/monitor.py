# SPDX-License-Identifier: Apache-2.0
"""Success, failure and phase of a task, from the states of a plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..model.compiled import CompiledScene, compile_scene
from ..scene.waypoints import is_of
from ..task.conditions import Conditions, StateSnapshot
from ..task.goal import GOAL, Comparison, GoalError, goal_error
from ..task.task import task_layout
from .snapshots import ObservedSnapshots

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..model.state import State
    from ..scene.schema import Scene
    from ..task.task import Task

SLACK = 1e-6
"""Tolerance of lapses of time [s]: times are sums of steps."""


@dataclass(frozen=True)
class Progress:
    """A number with a bound, over a run or a phase of it."""

    last: Comparison
    best: Comparison
    """Nearest to its bound, or farthest within."""
    when: float
    """Time of the best [s]."""


class Monitor:
    """Looks at every state of one plant: success, failures, and what the task goes on to its next phase on.

    A simulated :class:`~warpmpc.Plant` has one. For a robot of your own, hand it what you observe, before the plan:

        >>> monitor = warpmpc.Monitor(scene, task=mpc.task)
        >>> while not monitor.update(state := robot.observe()) and monitor.failure is None:
        ...     robot.apply(mpc.step(state))

    Args:
        scene: The scene.
        task: The task, whose phase it advances: that of the controller.
        e: Environment of the task.
        terms: Users' own cost terms that success, failures or phases name.
        compiled: The scene compiled earlier, to save doing it again.

    Raises:
        SceneError: If a condition names a frame, joint or term that does not exist.
    """

    error: GoalError | None
    """Distance of the goal's object or frame from the goal; None for a scene without a goal, or before any state."""
    body_q: np.ndarray | None
    """Poses of bodies ``[nb, 7]`` by the last finite state that was observed; None before any, of a simulated plant."""
    phases: list[tuple[str, float]]
    """Phases that were entered after the first, and when [s]."""
    progress: list[Progress]
    """Numbers that the success, or the end of the present phase, waits for; empty before any state."""
    failure: str | None
    """Name of the failure that came first, None while there is none; what comes later is no success."""

    def __init__(
        self,
        scene: Scene,
        *,
        task: Task,
        e: int = 0,
        terms: Sequence[UserTerm] = (),
        compiled: CompiledScene | None = None,
    ):
        self._scene, self._task, self._e, self._terms = scene, task, e, terms
        layout = self._layout = task_layout((compiled or compile_scene(scene)).layout, scene)
        self._frame = None if scene.goal is None else layout.frame(scene.goal.target, key="goal")

        def conditions(rows: tuple, key: str) -> Conditions:
            return Conditions(rows, layout, task, e, scene=scene, key=key)

        self._success = conditions(scene.success.conditions if scene.success else (), "success.conditions")
        rows = scene.failure
        self._fails = [conditions(f.conditions, f"failure.{f.name}.conditions") for f in rows]
        self._until = [conditions(phase.until, f"phase.{phase.name}.until") for phase in scene.phase]
        self._seen: ObservedSnapshots | None = None  # a simulated plant needs none
        self.reset()

    def reset(self) -> None:
        """Begin with the first state of a run; a task that went on to other phases begins anew."""
        if self._task.phase[self._e]:
            self._task.reset(self._e)
        self.error = self.body_q = None
        self.phases = []
        self._reached = 0
        self.failure = None
        self.progress = []
        self._now: float | None = None  # time of the last state
        self._within: float | None = None  # since when the success test holds
        self._held: float | None = None  # since when the phase's conditions hold
        self._entered = self._begun = 0.0  # when the phase began, and the run
        self._failing: list[float | None] = [None] * len(self._fails)  # since when each failure's conditions hold
        if self._seen:
            self._seen.reset()

    def update(self, state: State, control: np.ndarray | None = None) -> bool:
        """Take note of an observed state; returns :attr:`success`.

        Args:
            state: The state; without a time it counts as one control after the last. While it is not finite, success
                and conditions do not hold.
            control: The control ``[nu]`` that led to it, for conditions on cost terms that read controls.

        Raises:
            SceneError: If a condition is about a cost term that reads contact forces or sensors.
        """
        if self._seen is None:
            args = (self._scene, self._layout, self._task, self._e, self._scene.watched_terms)
            self._seen = ObservedSnapshots(*args, terms=self._terms)
        if state.time is None:
            time = 0.0 if self._now is None else self._now + self._scene.timing.control_dt
        else:
            time = float(np.broadcast_to(state.time, self._task.envs)[self._e])
        snapshot = self._seen(state, control, time)
        self.body_q = self.body_q if snapshot is None else snapshot.body_q
        if snapshot is None:
            self._pass(time)
            self._within = self._held = None
            self._failing = [None] * len(self._fails)
        else:
            self.check(snapshot, time)
        return self.success

    def check(self, snapshot: StateSnapshot, time: float) -> None:
        """Take note of a state.

        Args:
            snapshot: The state.
            time: Its time [s].
        """
        scene, task, e = self._scene, self._task, self._e
        self._pass(time)
        if scene.goal is not None:
            pose = self._success.frame_pose(snapshot, self._frame)
            self.error = goal_error(scene.goal, snapshot.pose(GOAL, task, e), pose)
        last_phase = self._in_last_phase
        wanted = scene.success if last_phase else None
        reached = False
        if wanted:
            of_goal = self.error.compared(wanted) if self.error else ()
            reached = self._progress([*of_goal, *self._success.compared(snapshot)])
        self._within = self._since(self._within, reached)
        self._note_failures(snapshot)
        if not last_phase:
            self._advance(snapshot)

    @property
    def _in_last_phase(self) -> bool:
        phases = self._scene.phase
        return not phases or self._task.phase[self._e] == len(phases) - 1

    def compared(self, snapshot: StateSnapshot) -> list[Comparison]:
        """Compare what the success, or the end of the present phase, waits for with its bounds; notes nothing."""
        scene, task, e = self._scene, self._task, self._e
        if not self._in_last_phase:
            return list(self._until[task.phase[e]].compared(snapshot))
        of_goal = ()
        if scene.success is not None and scene.goal is not None:
            pose = self._success.frame_pose(snapshot, self._frame)
            of_goal = goal_error(scene.goal, snapshot.pose(GOAL, task, e), pose).compared(scene.success)
        return [*of_goal, *self._success.compared(snapshot)]

    def _pass(self, time: float) -> None:
        """Move the clock on; the first phase begins with the first state."""
        if self._now is None:
            self._entered = self._begun = time
        self._now = time

    def _note_failures(self, snapshot: StateSnapshot) -> None:
        """Take note of the first failure that holds long enough, where there is no success."""
        phase = self._scene.phase[self._task.phase[self._e]].name if self._scene.phase else None
        for i, (failure, conditions) in enumerate(zip(self._scene.failure, self._fails, strict=True)):
            begun = self._begun if failure.phase is None else self._entered
            counts = (failure.phase is None or is_of(phase, failure.phase)) and self._lasted(begun, failure.after)
            self._failing[i] = self._since(self._failing[i], counts and conditions.hold(snapshot))
            if self.failure is None and not self.success and self._lasted(self._failing[i], failure.hold):
                self.failure = failure.name

    def _advance(self, snapshot: StateSnapshot) -> None:
        """Go on to the next phase when this one has what it waits for."""
        task, e = self._task, self._e
        phase, until = task.phase_of(e), self._until[task.phase[e]]
        self._held = self._since(self._held, bool(phase.until) and self._progress(list(until.compared(snapshot))))
        over = phase.after is not None and self._lasted(self._entered, phase.after)
        come = self._lasted(self._held, phase.hold)
        if over or come:
            self._reached += come
            task.enter_phase(int(task.phase[e]) + 1, e)
            self._held, self._entered, self.progress = None, self._now, []
            self.phases.append((task.phase_of(e).name, self._now))

    @property
    def success(self) -> bool:
        """Return whether what is wanted holds and did so long enough; never where the scene has no success."""
        wanted = self._scene.success
        return wanted is not None and self.failure is None and self._lasted(self._within, wanted.hold)

    @property
    def reached(self) -> int:
        """Phases that ended because what they wait for had come, not by ``after``; the last one with the success."""
        return self._reached + (self.success and bool(self._scene.phase))

    def _progress(self, comparisons: list[Comparison]) -> bool:
        """Keep how near each number came to its bound; returns whether all are within."""
        known = self.progress or [Progress(new, new, self._now) for new in comparisons]
        self.progress = []
        for new, old in zip(comparisons, known, strict=True):
            nearer = np.isnan(old.best.excess) or new.excess < old.best.excess
            self.progress.append(Progress(new, new, self._now) if nearer else replace(old, last=new))
        return all(comparison.holds for comparison in comparisons)

    def _since(self, since: float | None, holds: bool) -> float | None:
        """Since when something holds without a break [s], which it did since a time, or not."""
        if not holds:
            return None
        return self._now if since is None else since

    def _lasted(self, since: float | None, long: float) -> bool:
        return since is not None and self._now - since >= long - SLACK
