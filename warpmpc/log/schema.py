# SPDX-License-Identifier: Apache-2.0
"""Tables and columns of a run log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

FORMAT = "warpmpc run log 1"


class Column(NamedTuple):
    """One column of a table."""

    text: str
    unit: str = ""
    shape: tuple[str | int, ...] = ()
    """Axes of a row: numbers, or names of sizes."""
    dtype: str = "f8"


Q, QD = "m, rad", "m/s, rad/s"
U = "units of the drives"
"""Unit of controls."""

TABLES: dict[str, dict[str, Column]] = {
    # true states of the plant: one before each control, one at the end
    "states": {
        "time": Column("simulated time", "s"),
        "joint_q": Column("joint coordinates", Q, ("nq",)),
        "joint_qd": Column("joint velocities", QD, ("nv",)),
        "body_q": Column("poses of bodies in the world (x, y, z, qx, qy, qz, qw)", "m", ("nb", 7)),
        "contact_force": Column(
            "net force on the first of a pair at the last physics step, NaN at the start", "N", ("pairs", 3)
        ),
        "goal_error": Column("distances to the goal", Q, ("errors",)),
    },
    # what was sent: a control, or a tick in real time
    "controls": {
        "control": Column("control applied, NaN where none was sent", U, ("nu",)),
        "plan": Column("number of the newest plan, -1 before the first", dtype="i8"),
        "plan_ms": Column("wall time of that plan", "ms"),
        "following": Column("whether the control came from that plan, not from the watchdog", dtype="?"),
        "late_ms": Column("lateness of the tick in wall time", "ms"),
        "age": Column("time since the observation that the plan was made from, NaN without a plan", "s"),
        "clock": Column("clock of the robot", "s"),
        "seen_time": Column("time of the observation", "s"),
        "seen_q": Column("observed joint coordinates, NaN where their count was wrong", Q, ("nq",), "f4"),
        "seen_qd": Column("observed joint velocities", QD, ("nv",), "f4"),
        "seen_act": Column("observed activations", "", ("na",), "f4"),
        "seen_mocap": Column("observed poses of mocap bodies", "m", ("nm", 7), "f4"),
    },
    # what plans were made from and what they came to
    "plans": {
        "number": Column("number of the plan; one that its planner did not hand over has that of the next", dtype="i8"),
        "time": Column("time of the observation", "s"),
        "joint_q": Column("observed joint coordinates", Q, ("nq",), "f4"),
        "joint_qd": Column("observed joint velocities", QD, ("nv",), "f4"),
        "act": Column("observed activations, NaN where they were left out", "", ("na",), "f4"),
        "mocap": Column("observed poses of mocap bodies, NaN where they were left out", "m", ("nm", 7), "f4"),
        "task": Column("poses, scalars and weights: a row of Task.block", "", ("task",), "f4"),
        "lower": Column("lower limits of the controls", U, ("nu",), "f4"),
        "upper": Column("upper limits of the controls", U, ("nu",), "f4"),
        "cost": Column("cost of the best sample"),
        "terms": Column("share of each term in it, weighted and discounted", "", ("terms",)),
        "beta": Column("temperature β that weighed the samples next time"),
        "eta": Column("effective number of samples η"),
        "command": Column("command that the controller returned", U, ("nu",), "f4"),
        "knot_time": Column("times of the knots", "s", ("knots",)),
        "knots": Column("the plan", U, ("knots", "nu"), "f4"),
        # in real time
        "life": Column("planner process that made it, from 0", dtype="i8"),
        "sent": Column("control that the robot was sent last", U, ("nu",), "f4"),
        "following": Column("whether that came from a plan", dtype="?"),
        "reach": Column("time by which the observation was predicted forward", "s"),
        "latency": Column("time from the observation to the plan", "s"),
        "plan_ms": Column("wall time of the planning", "ms"),
        "survived": Column("whether a rollout survived", dtype="?"),
    },
    # changes of the watchdog's faults: the last row of an index holds
    "faults": {
        "index": Column("number of the fault", dtype="i8"),
        "kind": Column("kind of the fault", dtype="U64"),
        "why": Column("a sentence about it", dtype="U240"),
        "start": Column("begin on the clock of the robot", "s"),
        "end": Column("end, NaN while it lasts", "s"),
        "count": Column("times it came and went", dtype="i8"),
    },
    # points of clouds, at the first plan that saw them
    "clouds": {
        "cloud": Column("index of the cloud among its names", dtype="i8"),
        "plan": Column("row of the plan", dtype="i8"),
        "begins": Column("whether a new set of points follows; this row holds none", dtype="?"),
        "point": Column("a point", "m", (3,), "f4"),
    },
}
"""Columns by table."""

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
FORCE = ("x", "y", "z")


def row_type(table: str, sizes: Mapping[str, int], columns: Sequence[str] | None = None) -> np.dtype:
    """Type of a row of a table.

    Args:
        sizes: Sizes of the axes by name.
        columns: Columns that are kept, all of them if None.
    """
    kept = [(name, TABLES[table][name]) for name in columns or TABLES[table]]
    return np.dtype([(name, c.dtype, tuple(sizes.get(axis, axis) for axis in c.shape)) for name, c in kept])
