# SPDX-License-Identifier: Apache-2.0
"""A run in real time, tick by tick, kept without disturbing the loop: numbers into memory taken beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .history import History, names_of, turning
from .tick_log import TickLog

if TYPE_CHECKING:
    from ..model.state import State
    from ..plant.plant import Plant
    from ..realtime.agent import Fault
    from ..realtime.letters import TimedPlan
    from ..realtime.real_time_log import RealTimeLog

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
        self._seen = (layout.nq, layout.nv, layout.na, 7 * layout.nm)
        widths = [1, layout.nq, layout.nv, 7 * layout.nb, 3 * len(plant.pairs), errors, layout.nu, 6, 1, *self._seen]
        self._ends = np.cumsum(widths)
        self._rows: list[np.ndarray] = []
        self._count = 0
        self._take(np.full(self._ends[-1] - self._ends[5], np.nan))
        if plant.pairs:
            self._rows[0][0, self._ends[3] : self._ends[4]] = np.nan  # nothing has moved yet

    def log(
        self,
        control: np.ndarray | None,
        timed: TimedPlan | None,
        *,
        seen: State,
        now: float,
        following: bool,
        late: float,
    ) -> None:
        """Keep one tick; the robot has got its command.

        Args:
            control: The control ``[nu]`` that was sent, None where none was.
            timed: The newest plan, None before the first.
            seen: What was observed.
            now: The robot's clock [s].
            following: Whether the control came from the plan.
            late: How late the tick was, in wall time [s].
        """
        nothing, layout = np.nan, self._plant.layout
        plan = (-1.0, nothing, nothing) if timed is None else (timed.number, timed.observed, timed.plan_ms)
        sent = np.full(layout.nu, nothing) if control is None else control
        act, mocap = (a if b is None else b for a, b in ((layout.act, seen.act), (layout.mocap, seen.mocap)))
        parts = zip((seen.joint_q, seen.joint_qd, act, mocap), self._seen, strict=True)
        shown = [np.ravel(part) if np.size(part) == width else np.full(width, nothing) for part, width in parts]
        self._take(np.concatenate([sent, [*plan, following, 1e3 * late, now, seen.time], *shown]))

    def _take(self, about: np.ndarray) -> None:
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
        row[ends[5] :] = about
        self._count += 1

    def history(self, faults: Sequence[Fault], made: RealTimeLog | None = None) -> History:
        """The run so far: rows are ticks, and what belongs to plans is that of the newest plan at each tick.

        Args:
            faults: What went wrong (``agent.faults``).
            made: What the plans were made from and came to (``planner.log``); without, costs, β and η, which stay with
                the planner, are NaN.
        """
        table = np.concatenate(self._rows)[: self._count]
        time, q, qd, bodies, forces, errors, control, about, *seen = np.split(table, self._ends[:-1], axis=1)
        layout = self._plant.layout
        number, observed, plan_ms, following, late_ms, now = about[1:].T
        seen_time, *shown = (part[1:] for part in seen)
        seen_q, seen_qd, seen_act, seen_mocap = (part.astype(np.float32) for part in shown)
        return History(
            time=time[:, 0],
            joint_q=q,
            joint_qd=qd,
            body_q=bodies.reshape(-1, layout.nb, 7),
            contact_force=forces.reshape(len(time), -1, 3),
            control=control[1:],
            plan_ms=plan_ms,
            goal_error=errors,
            **_costs(number.astype(int), made),
            **names_of(self._plant, self._turning),
            made=made,
            ticks=TickLog(
                plan=number.astype(int),
                following=following.astype(bool),
                late_ms=late_ms,
                age=time[:-1, 0] - observed,
                faults=tuple(faults),
                now=now,
                seen_time=seen_time[:, 0],
                seen_q=seen_q,
                seen_qd=seen_qd,
                seen_act=seen_act,
                seen_mocap=seen_mocap.reshape(len(now), layout.nm, 7),
            ),
        )


def _costs(number: np.ndarray, made: RealTimeLog | None) -> dict[str, Any]:
    """What the newest plans cost, by fields of :class:`History`.

    Args:
        number: Number of the newest plan at each tick ``[N]``.
        made: The plans, if they are known.
    """
    names = () if made is None else made.term_names
    rows = np.full(len(number), -1) if made is None else made.rows(number)
    known, columns = rows >= 0, {}
    for name in ("cost", "cost_terms", "beta", "eta"):
        values = np.full((len(number), *([len(names)] if name == "cost_terms" else [])), np.nan)
        if made is not None:
            values[known] = (made.terms if name == "cost_terms" else getattr(made, name))[rows[known]]
        columns[name] = values
    return {**columns, "term_names": names}
