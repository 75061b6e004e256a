# SPDX-License-Identifier: Apache-2.0
"""What a planner notes of every plan, where its death takes nothing of it: a file of rows of numbers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..controller.provenance import provenance
from .real_time_log import RealTimeLog

if TYPE_CHECKING:
    from ..controller.controller import Controller
    from .letters import Sighting, TimedPlan


class Journal:
    """Turns plans into rows of numbers.

    Args:
        controller: Makes the plans, of one environment.
        write: Takes each row.
    """

    def __init__(self, controller: Controller, write: Callable[[np.ndarray], None]):
        self._controller, self._write = controller, write
        layout, knots = controller.layout, len(controller.planner.knot_time)
        nu, one = layout.nu, ()
        self.about: dict[str, Any] = {
            "origin": provenance(controller),
            "terms": list(controller.costs.labels),
            "shapes": {
                "time": one,
                "following": one,
                "joint_q": (layout.nq,),
                "joint_qd": (layout.nv,),
                "act": (layout.na,),
                "mocap": (layout.nm, 7),
                "command": (nu,),
                "task": (controller.task.block.shape[1],),
                "lower": (nu,),
                "upper": (nu,),
                "reach": one,
                "number": one,
                "latency": one,
                "plan_ms": one,
                "survived": one,
                "cost": one,
                "beta": one,
                "eta": one,
                "terms": (len(controller.costs.labels),),
                "knot_time": (knots,),
                "knots": (knots, nu),
            },
        }
        """Plain data that tells what is in a row, and where the plans come from."""

    def note(self, sighting: Sighting, reach: float, timed: TimedPlan) -> None:
        """Note the newest plan.

        Args:
            sighting: What it was made from.
            reach: How far that was predicted forward [s].
            timed: The plan.
        """
        controller, state, plan = self._controller, sighting.state, timed.plan
        info, layout = controller.info, controller.layout
        act = np.full(layout.na, np.nan) if state.act is None else state.act
        mocap = np.full(7 * layout.nm, np.nan) if state.mocap is None else np.ravel(state.mocap)
        row = (
            [state.time, sighting.following],
            *(state.joint_q, state.joint_qd, act, mocap, sighting.command),
            *(controller.planned_task[0], plan.lower, plan.upper),
            [reach, timed.number, timed.latency, timed.plan_ms, timed.survived, info.cost, info.beta, info.eta],
            *(list(info.terms.values()), plan.times, plan.knots.ravel()),
        )
        self._write(np.concatenate(row, dtype=float))


class FileJournal(Journal):
    """A journal in a file. What is written there outlives the process; where nothing can be written, none is kept.

    Args:
        controller: Makes the plans.
        folder: Where planners that follow one another have a file each: a line of JSON, then rows of doubles.
    """

    def __init__(self, controller: Controller, folder: Path):
        super().__init__(controller, self._append)
        self._file = None
        try:
            self._file = (folder / f"{len(list(folder.iterdir())):04d}").open("wb", buffering=0)
            self._file.write(json.dumps(self.about, ensure_ascii=False).encode() + b"\n")
        except OSError:
            self._file = None

    def _append(self, row: np.ndarray) -> None:
        if self._file is None:
            return
        try:
            whole = self._file.write(row.tobytes()) == row.nbytes
        except OSError:
            whole = False
        if not whole:  # the disk is full, say: plans are worth more than what is noted of them
            self._file = None


def read_journals(folder: Path) -> RealTimeLog | None:
    """What planners that followed one another noted in the files of a folder, in the order of their names.

    Rows that were being written when a planner died are left out. None where no planner noted anything.

    Raises:
        OSError: If a file cannot be read.
    """
    about, lives = None, []
    for path in sorted(folder.iterdir()):
        head, line, rows = path.read_bytes().partition(b"\n")
        if not line:
            continue
        about = json.loads(head)
        width = sum(int(np.prod(shape)) for shape in about["shapes"].values())
        whole = len(rows) // (8 * width)
        lives.append(np.frombuffer(rows[: whole * 8 * width]).reshape(whole, width))
    return None if about is None else RealTimeLog.of(about, lives)
