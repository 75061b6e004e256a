# SPDX-License-Identifier: Apache-2.0
"""A run in real time, tick by tick, kept without disturbing the loop: numbers into memory taken beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .history import History, names_of, turning
from .tick_log import TickLog

if TYPE_CHECKING:
    from ..plant.simulated import Plant
    from ..realtime.agent import Fault
    from ..realtime.letters import TimedPlan

ROWS = 8192
"""Ticks for which memory is taken at once."""


class TickRecorder:
    """Keeps what a simulated robot and its agent do at every tick; hand it to ``RobotLoop``.

    A tick costs copies of some numbers. Nothing is written before the run is over, and what is kept does not depend on
    the planner's process.

    Args:
        plant: The simulated robot (:func:`warpmpc.simulated_robot`), at the start of its episode.
    """

    def __init__(self, plant: Plant):
        self._plant, layout = plant, plant.layout
        self._turning = turning(plant.scene)
        errors = 0 if plant.error is None else 1 + len(self._turning)
        widths = [1, layout.nq, layout.nv, 7 * layout.nb, 3 * len(plant.pairs), errors, layout.nu, 5]
        self._ends = np.cumsum(widths)
        self._rows: list[np.ndarray] = []
        self._count = 0
        self._take(np.full(layout.nu, np.nan), np.full(5, np.nan))
        if plant.pairs:
            self._rows[0][0, self._ends[3] : self._ends[4]] = np.nan  # nothing has moved yet

    def log(self, control: np.ndarray | None, timed: TimedPlan | None, *, following: bool, late: float) -> None:
        """Keep one tick; the robot has got its command.

        Args:
            control: The control ``[nu]`` that was sent, None where none was.
            timed: The newest plan, None before the first.
            following: Whether the control came from it.
            late: How late the tick was, in wall time [s].
        """
        nothing = np.nan
        plan = (-1.0, nothing, nothing) if timed is None else (timed.number, timed.observed, timed.plan_ms)
        sent = np.full(self._plant.layout.nu, np.nan) if control is None else control
        self._take(sent, np.array([*plan, following, 1e3 * late]))

    def _take(self, control: np.ndarray, about: np.ndarray) -> None:
        if self._count % ROWS == 0:
            self._rows.append(np.zeros((ROWS, self._ends[-1])))
        row, plant, ends = self._rows[-1][self._count % ROWS], self._plant, self._ends
        state, error = plant.state, plant.error
        row[0] = plant.time
        row[ends[0] : ends[1]], row[ends[1] : ends[2]] = state.joint_q, state.joint_qd
        row[ends[2] : ends[3]] = plant.body_q.ravel()
        if plant.pairs and self._count:
            row[ends[3] : ends[4]] = np.ravel(plant.forces)
        if error is not None:
            row[ends[4] : ends[5]] = [error.position, *(getattr(error, name) for name in self._turning)]
        row[ends[5] : ends[6]], row[ends[6] :] = control, about
        self._count += 1

    def history(self, faults: Sequence[Fault]) -> History:
        """The run so far: rows are ticks; costs, β and η, which stay with the planner, are NaN.

        Args:
            faults: What went wrong (``agent.faults``).
        """
        table = np.concatenate(self._rows)[: self._count]
        time, q, qd, bodies, forces, errors, control, about = np.split(table, self._ends[:-1], axis=1)
        layout, ticks, unknown = self._plant.layout, self._count - 1, np.full(self._count - 1, np.nan)
        number, observed, plan_ms, following, late_ms = about[1:].T
        return History(
            time=time[:, 0],
            joint_q=q,
            joint_qd=qd,
            body_q=bodies.reshape(-1, layout.nb, 7),
            contact_force=forces.reshape(len(time), -1, 3),
            control=control[1:],
            cost=unknown,
            cost_terms=np.zeros((ticks, 0)),
            plan_ms=plan_ms,
            beta=unknown,
            eta=unknown,
            goal_error=errors,
            term_names=(),
            **names_of(self._plant, self._turning),
            ticks=TickLog(
                plan=number.astype(int),
                following=following.astype(bool),
                late_ms=late_ms,
                age=time[:-1, 0] - observed,
                faults=tuple(faults),
            ),
        )
