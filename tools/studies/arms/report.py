# SPDX-License-Identifier: Apache-2.0
"""Records of many poses as one line of a table."""

from __future__ import annotations

import numpy as np

COLUMNS = (
    "",
    "poses",
    "reached",
    "touched",
    "both",
    "time [s] mean ± std",
    "median",
    "p90",
    "error [mm]",
    "[mrad]",
    "q̈ max [rad/s²]",
    "jerk max, rms [rad/s³]",
    "limits kept",
    "missed seeds",
)


FIGURES = ("", "reached", "touched", "time [s], mean ± std", "median error", "jerk max, rms [rad/s³]", "limits kept")
FIGURES = (*FIGURES, "plan [ms]")
"""Columns of ``docs/data``."""


def figures(name: str, records: list[dict]) -> list[str]:
    """One row of ``docs/data``; for the least time there is no run."""
    cells = [cell.strip() for cell in summary(name, records).strip("| ").split(" | ")]
    if records[0]["position_error_m"] is None:
        return [name, "", "", cells[5], "", "", "", ""]
    _, poses, reached, touched, _, time, _, _, near, turned, _, jerk, kept, *_ = cells
    plan = f"{np.median([record['plan_ms'] for record in records]):.3g}"
    time, error = (time, f"{near} mm, {turned} mrad") if int(reached) else ("-", "-")
    return [name, f"{reached} of {poses}", touched, time, error, jerk, kept, plan]


def line() -> str:
    """The head of the table."""
    return f"| {' | '.join(COLUMNS)} |\n|{' --- |' * len(COLUMNS)}"


def summary(name: str, records: list[dict]) -> str:
    """One row: errors are medians of those that were reached, jerk's root mean square is the median over poses."""
    reached = [record for record in records if record["reached"]]
    good = [record for record in reached if not record["touched"]]
    times = np.array([record["time_s"] for record in reached] or [np.nan])
    missed = [str(record["seed"]) for record in records if record not in good]

    def over(key: str, among: list[dict]) -> np.ndarray:
        return np.array([record[key] for record in among if record[key] is not None] or [np.nan])

    cells = [
        name,
        str(len(records)),
        str(len(reached)),
        str(sum(bool(record["touched"]) for record in records)),
        str(len(good)),
        f"{times.mean():.2f} ± {times.std():.2f}",
        f"{np.median(times):.2f}",
        f"{np.percentile(times, 90):.2f}",
        f"{1e3 * np.median(over('position_error_m', reached)):.1f}",
        f"{1e3 * np.median(over('rotation_error_rad', reached)):.0f}",
        f"{over('max_acceleration', records).max():.1f}",
        f"{over('max_jerk', records).max():.0f}, {np.median(over('rms_jerk', records)):.1f}",
        str(sum(record["limits_kept"] for record in records)),
        ", ".join(missed[:12]) + (", ..." if len(missed) > 12 else ""),
    ]
    return f"| {' | '.join(cells)} |"
