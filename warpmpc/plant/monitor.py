# SPDX-License-Identifier: Apache-2.0
"""Whether a plant has reached what the task wants, and which phase of it is on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..task.conditions import Conditions, Look
from ..task.goal import GOAL, GoalError, goal_error

if TYPE_CHECKING:
    from ..model.layout import Layout
    from ..scene.schema import Scene
    from ..task.task import Task


class Monitor:
    """Looks at every state of one plant: success, and the conditions on which the task goes on to its next phase.

    Args:
        scene: The scene.
        layout: Its layout, targets included.
        task: The task, whose phase it advances.
        e: Environment of the task.

    Raises:
        SceneError: If a condition names a frame, joint or term that does not exist.
    """

    error: GoalError | None
    """How far the goal's object or frame is from the goal; None for a scene without a goal."""

    def __init__(self, scene: Scene, layout: Layout, task: Task, e: int = 0):
        self._scene, self._layout, self._task, self._e = scene, layout, task, e
        self._frame = None if scene.goal is None else layout.frame(scene.goal.target, key="goal")

        def conditions(rows: tuple, key: str) -> Conditions:
            return Conditions(rows, layout, task, e, scene=scene, key=key)

        self._success = conditions(scene.success.conditions, "success.conditions")
        self._until = [conditions(phase.until, f"phase.{phase.name}.until") for phase in scene.phase]
        self.reset()

    @property
    def watched_terms(self) -> set[str]:
        """Cost terms that any condition looks at."""
        rows = [*self._scene.success.conditions, *(c for phase in self._scene.phase for c in phase.until)]
        return {condition.term for condition in rows if condition.term is not None}

    def reset(self) -> None:
        """Begin with the first state of a run; a task that went on to other phases begins anew."""
        if self._task.phase[self._e]:
            self._task.reset(self._e)
        self.error = None
        self.phases: list[tuple[str, float]] = []
        """Phases that were entered after the first, and when [s]."""
        self._within = 0  # states in a row in which the success test holds
        self._held = 0  # states in a row in which the phase's conditions hold
        self._entered = 0  # step at which the phase began

    def look(self, look: Look, step: int) -> None:
        """Take note of a state.

        Args:
            look: The state.
            step: Number of controls that led to it.
        """
        scene, task, e = self._scene, self._task, self._e
        if scene.goal is not None:
            pose = self._success.frame_pose(look, self._frame)
            self.error = goal_error(scene.goal, task.pose(GOAL, e), pose)
        last_phase = not scene.phase or task.phase[e] == len(scene.phase) - 1
        reached = last_phase and (self.error is None or self.error.within(scene.success)) and self._success.hold(look)
        self._within = self._within + 1 if reached else 0
        if not last_phase:
            self._advance(look, step)

    def _advance(self, look: Look, step: int) -> None:
        """Go on to the next phase when this one has what it waits for."""
        task, e, dt = self._task, self._e, self._scene.timing.control_dt
        phase, until = task.phase_of(e), self._until[task.phase[e]]
        holds = bool(phase.until) and until.hold(look)
        self._held = self._held + 1 if holds else 0
        over = phase.after is not None and (step - self._entered) * dt >= phase.after - 1e-9
        if over or self._lasted(self._held, phase.hold):
            task.enter_phase(int(task.phase[e]) + 1, e)
            self._held, self._entered = 0, step
            self.phases.append((task.phase_of(e).name, step * dt))

    @property
    def success(self) -> bool:
        """Whether everything that is wanted holds and did so long enough."""
        return self._lasted(self._within, self._scene.success.hold)

    def _lasted(self, states: int, hold: float) -> bool:
        # states stand at the ends of steps: n steps of holding are n + 1 states
        return states - 1 >= hold / self._scene.timing.control_dt - 1e-6
