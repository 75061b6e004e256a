# SPDX-License-Identifier: Apache-2.0
"""Success, failure and phase of a task, from the states of a plant.

Quantities that conditions look at, from states that were observed without simulation.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...cost.plant_values import TermValues
from ...kernels.geometry.kinematics import forward_kinematics_kernel
from ...physics.runtime.launch import Launcher, capturing
from ...scene.errors import SceneError
from ...scene.model.compiled import CompiledScene, compile_scene
from ...scene.model.joints import joint_table
from ...scene.model.trajectory import BatchSize, Trajectory
from ...scene.schema_goal import is_of
from ...scene.task.conditions import Conditions, StateSnapshot
from ...scene.task.goal import GOAL, Comparison, GoalError, goal_error
from ...scene.task.task import task_layout

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...scene.model.layout import Layout
    from ...scene.model.state import State
    from ...scene.schema import Scene
    from ...scene.task.task import Task


class ObservedSnapshots:
    """Bodies follow from joints, cost terms from two states and the control between them.

    Args:
        scene: The scene.
        layout: Its layout, targets included.
        task: The task.
        e: Environment of the task.
        labels: Cost terms that are looked at.
        terms: Users' own cost terms.

    Raises:
        SceneError: If a term reads what a state does not tell: contact forces or sensors.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        task: Task,
        e: int,
        labels: Collection[str],
        *,
        terms: Sequence[UserTerm] = (),
    ):
        shape, self._e = BatchSize(task.envs, 1, 1, 1), e
        self._launch = Launcher("cpu")
        self._table = joint_table(layout, "cpu", worlds=task.envs)
        self._trajectory = Trajectory.allocate(shape, layout, 0, "cpu")
        self._values = TermValues(scene, layout, task, labels, terms=terms) if labels else None
        if self._values:
            if self._values.pairs or self._values.sensors:
                raise SceneError(
                    "conditions on cost terms that read contact forces or sensors need a simulated plant",
                    key="cost",
                    file=scene.path,
                    found=sorted(labels),
                )
            self._values.attach(self._trajectory, self._trajectory.control, shape, scene.timing.control_dt)
        self.reset()

    def reset(self) -> None:
        """The next state is the first one."""
        self._before: float | None = None

    def __call__(self, state: State, control: np.ndarray | None, time: float) -> StateSnapshot | None:
        """Compute them for a state, None where it is not finite.

        Args:
            state: The state, of all environments or of this one.
            control: The control ``[nu]`` that led to it.
            time: Its time [s].
        """
        out, poses = self._trajectory, self._table.mocap_pose.numpy()
        rows = [(out.joint_q.numpy(), state.joint_q, 1), (out.joint_qd.numpy(), state.joint_qd, 1)]
        rows = [(array, self._row(value, axes)) for array, value, axes in rows]
        mocap = poses[self._e] if state.mocap is None else self._row(state.mocap, 2)
        if not all(np.isfinite(value).all() for value in (*(value for _, value in rows), mocap)):
            return None
        poses[:] = mocap
        for array in (*(array for array, _ in rows), out.body_q.numpy(), out.body_qd.numpy()):
            array[0] = array[1]
        for array, value in rows:
            array[1] = value
        after = (array[1:] for array in (out.joint_q, out.joint_qd, out.body_q, out.body_qd))
        joint_q, joint_qd, body_q, body_qd = after
        self._launch(forward_kinematics_kernel, body_q.shape[:2], [self._table, joint_q, joint_qd], [body_q, body_qd])
        out.control.numpy()[:] = 0.0 if control is None else control
        values: dict[str, float] = {}
        if self._values and self._before is not None:
            with capturing:
                values = self._values([self._before] * len(poses))[self._e]
        self._before = time
        return StateSnapshot(out.body_q.numpy()[1, self._e].copy(), rows[0][1], values)

    def _row(self, values: np.ndarray, axes: int) -> np.ndarray:
        """This environment's part of what was observed."""
        values = np.asarray(values, dtype=np.float32)
        return values[self._e] if values.ndim > axes else values


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

    A simulated :class:`~warpmpc.Plant` has one. For your own robot, hand it what you observe, before the plan:

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

    def of_failure(self, state: State) -> list[Comparison]:
        """Compare what the failure that came looks at with its bounds, in any state; values of cost terms are NaN."""
        snapshot = ObservedSnapshots(self._scene, self._layout, self._task, self._e, ())(state, None, 0.0)
        return list(self._fails[self._failed].compared(snapshot))

    @property
    def failing_since(self) -> float | None:
        """Time since when the conditions of the failure that came hold [s]."""
        return None if self.failure is None else self._failing[self._failed]

    @property
    def _failed(self) -> int:
        return [failure.name for failure in self._scene.failure].index(self.failure)

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
