# SPDX-License-Identifier: Apache-2.0
"""Played episodes as a table, beside the returns of a learned agent."""

from __future__ import annotations

from statistics import mean

from .published import TD_MPC2

_HEAD = (
    "| task | return | by seed | TD-MPC2 | plan p50 / p99 [ms] | period [ms] | engine | samples | ahead [s] |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def table(played: list[dict]) -> str:
    """Markdown: a row for each task, and a line that counts them.

    Args:
        played: Episodes, the fields of :class:`~dm_tasks.play.Played`; those of a task with the same settings.
    """
    tasks = {name: sorted(_of(played, name), key=lambda row: row["seed"]) for name in sorted(_names(played))}
    rows = [_row(name, rows) for name, rows in tasks.items()]
    means = {name: mean(row["reward"] for row in rows) for name, rows in tasks.items()}
    return "\n".join([_HEAD, *rows, "", _summary(means, played)])


def _names(played: list[dict]) -> set[str]:
    return {row["task"] for row in played}


def _of(played: list[dict], name: str) -> list[dict]:
    return [row for row in played if row["task"] == name]


def _row(name: str, rows: list[dict]) -> str:
    first = rows[0]
    samples = f"{first['samples']}" + (f" × {first['iterations']}" if first["iterations"] > 1 else "")
    p50, p99 = (max(row["plan_ms"][q] for row in rows) for q in ("p50", "p99"))
    cells = (
        name.replace("_", " "),
        f"**{mean(row['reward'] for row in rows):.0f}**",
        ", ".join(f"{row['seed']}: {row['reward']:.0f}" for row in rows),
        f"{TD_MPC2[name]}" if name in TD_MPC2 else "-",
        f"{p50:.1f} / {p99:.1f}",
        f"{first['control_ms']:g}",
        first["engine"],
        samples,
        f"{first['horizon']:.2g}",
    )
    return f"| {' | '.join(cells)} |"


def _summary(means: dict[str, float], played: list[dict]) -> str:
    steps = sorted({row["steps"] for row in played})
    count = f"{steps[0]}" if len(steps) == 1 else f"{steps[0]} to {steps[-1]}"
    if steps != [1000]:
        return f"Episodes of {count} steps instead of the suite's 1000: not to be compared with anything."
    high, low = sum(value >= 800 for value in means.values()), sum(value < 300 for value in means.values())
    level = sum(value >= TD_MPC2[name] for name, value in means.items() if name in TD_MPC2)
    return (
        f"{high} of {len(means)} at 800 or more, {low} below 300, {level} at TD-MPC2's return or above. "
        "Plan times: the worst seed's."
    )
