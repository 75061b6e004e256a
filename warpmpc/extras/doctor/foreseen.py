# SPDX-License-Identifier: Apache-2.0
"""Record of an episode's controls and states, and of what its planner predicted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .foresight import Foresight, Steps, foresee, takes_mujoco_steps
from .verdict import Symptoms

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ...cost.term import UserTerm
    from ...loop.plant.plant import Plant
    from ...planner.controller.controller import Controller
    from ...scene.model.state import Info
    from ...scene.schema import Scene

BAD = 0.35
"""Error of the state after 0.2 s, as a share of its movement, from which a verdict mentions it."""


class StepRecorder:
    """Keeps what :class:`~warpmpc.extras.doctor.foresight.Steps` are made of.

    Args:
        scene: The scene, drawn for the episode.
        controller: The controller.
        plant: The plant; of one that shares its controller with others nothing is kept, for a batch would take longer.
        terms: Users' own cost terms that the scene names.
    """

    def __init__(self, scene: Scene, controller: Controller, plant: Plant, terms: Sequence[UserTerm] = ()):
        self.scene, self.controller, self.plant, self._terms = scene, controller, plant, terms
        self._known = controller.envs == 1 and takes_mujoco_steps(controller.engine.name, scene)
        self._rows: list[dict[str, np.ndarray]] = []

    def note(self, control: np.ndarray) -> None:
        """Keep the plan just made and its control ``[nu]``, before it is applied."""
        if not self._known:
            return
        seen, true = self.controller.observed, self.plant.state
        one = ... if seen.joint_q.ndim == 1 else 0
        self._rows.append(
            {
                "joint_q": true.joint_q,
                "joint_qd": true.joint_qd,
                "control": np.array(control),
                "seen_q": seen.joint_q[one],
                "seen_qd": seen.joint_qd[one],
                "seen": round(float(np.ravel(seen.time)[0]) / self.scene.timing.control_dt),
                "act": seen.act[one],
                "mocap": seen.mocap[one],
                "task": self.controller.planned_task[0],
            }
        )

    def foresight(self) -> Foresight | None:
        """Return what was foreseen of the episode so far; None where that is not known."""
        if not self._rows:
            return None
        rows, controller, end = self._rows, self.controller, self.plant.state
        columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        for name in ("joint_q", "joint_qd"):
            columns[name] = np.concatenate([columns[name], getattr(end, name)[None]])
        planned = {"engine": controller.engine.name, "device": str(controller.device), "terms": self._terms}
        return foresee(self.scene, controller.compiled, Steps(**columns), seed=self.plant.seed, **planned)


class Verdict:
    """Observer of an episode: what its planner predicted, and why an episode fails.

    Args:
        scene: The scene, drawn for the episode.
        controller: The controller.
        plant: The plant.
        terms: Users' own cost terms that the scene names.
    """

    def __init__(self, scene: Scene, controller: Controller, plant: Plant, terms: Sequence[UserTerm] = ()):
        self._symptoms, self._recorded = Symptoms(controller, plant), StepRecorder(scene, controller, plant, terms)

    def note(self, info: Info, control: np.ndarray) -> None:
        """Keep what the plan just made and its control ``[nu]`` show."""
        self._symptoms.note(info, control)
        self._recorded.note(control)

    def found(self, *, failed: bool, interrupted: bool) -> dict[str, object]:
        """``foresight``, ``verdict`` and ``shortfall`` of the result; nothing of an interrupted episode."""
        if interrupted:
            return {}
        foreseen = self._recorded.foresight()
        found: dict[str, object] = {"foresight": foreseen.numbers if foreseen else {}}
        if failed:
            shortfall = self._symptoms.shortfall()
            found |= {"verdict": (*map(str, shortfall.told), *foresight_signs(foreseen)), "shortfall": shortfall}
        return found


def foresight_signs(foresight: Foresight | None) -> Iterator[str]:
    """Yield a sentence where predictions are bad."""
    if foresight is not None and foresight.ahead > BAD:
        yield (
            f"the planner's predictions are wrong: after 0.2 s states are off by {foresight.ahead:.0%} of their "
            f"movement, costs by {foresight.cost:.0%}: run with --out DIR, and warpmpc diagnose DIR names the cause"
        )
