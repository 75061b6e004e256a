# SPDX-License-Identifier: Apache-2.0
"""Played episodes as a table, beside the returns of a learned agent."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import mean

from shared.intervals import mean as estimate

from .play import Played

TD_MPC2 = {
    "acrobot_swingup": 663,
    "ball_in_cup_catch": 984,
    "cartpole_swingup": 877,
    "cheetah_run": 896,
    "finger_spin": 991,
    "finger_turn_hard": 977,
    "fish_swim": 761,
    "hopper_stand": 955,
    "hopper_hop": 449,
    "humanoid_stand": 906,
    "humanoid_walk": 900,
    "humanoid_run": 603,
    "pendulum_swingup": 838,
    "quadruped_run": 954,
    "reacher_hard": 982,
    "walker_run": 877,
}
"""TD-MPC2 (Hansen et al., ICLR 2024): last points of its published curves, mean of 3 seeds after 4 million steps of
training, 14 million for the humanoid."""
_HEAD = (
    "| task | return | worst | seeds | TD-MPC2 | plan p50 / p99 [ms] | period [ms] | samples | ahead [s] |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def read(paths: Sequence[Path]) -> list[dict]:
    """Episodes of files that the tool wrote; those that several files share count once.

    Raises:
        ValueError: If a file is not one of these.
    """
    played = []
    for path in paths:
        try:
            rows = [asdict(Played(**row)) for row in json.loads(path.read_text(encoding="utf-8"))]
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: no episodes as tools/study.py dm_suite --json writes them: {error}") from None
        played += [row for row in rows if row not in played]
    return played


def table(played: list[dict]) -> str:
    """Markdown: a row for each task, and a line that counts them.

    Args:
        played: Episodes, the fields of :class:`~studies.suite.play.Played`.

    Raises:
        ValueError: If a task was played with different settings, or a seed of it twice.
    """
    tasks = {name: [row for row in played if row["task"] == name] for name in sorted({row["task"] for row in played})}
    for name, rows in tasks.items():
        if len({(row["settings"], row["engine"], row["steps"]) for row in rows}) > 1:
            raise ValueError(f"{name}: episodes of different settings, engines or lengths do not go into one mean")
        if len({row["seed"] for row in rows}) < len(rows):
            raise ValueError(f"{name}: a seed was played twice")
    means = {name: mean(row["reward"] for row in rows) for name, rows in tasks.items()}
    return "\n".join([_HEAD, *(_row(name, rows) for name, rows in tasks.items()), "", _summary(means, played)])


def _row(name: str, rows: list[dict]) -> str:
    first, returns = rows[0], [row["reward"] for row in rows]
    found = estimate(returns)
    samples = f"{first['samples']}" + (f" × {first['iterations']}" if first["iterations"] > 1 else "")
    p50, p99 = (max(row["plan_ms"][q] for row in rows) for q in ("p50", "p99"))
    cells = (
        name.replace("_", " "),
        f"**{mean(returns):.0f}**" + ("" if found.high is None else f" ± {found.high - found.value:.0f}"),
        f"{min(returns):.0f}",
        f"{len(returns)}",
        f"{TD_MPC2[name]}" if name in TD_MPC2 else "-",
        f"{p50:.1f} / {p99:.1f}",
        f"{first['control_ms']:g}",
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
    seeds = sorted({row["seed"] for row in played})
    first = [x for x in seeds if x - 1 not in seeds]
    blocks = [f"{x} to {y}" for x, y in zip(first, [x for x in seeds if x + 1 not in seeds], strict=True)]
    return (
        f"{high} of {len(means)} at 800 or more, {low} below 300, {level} at TD-MPC2's return or above. "
        f"Seeds {' and '.join(blocks)}; ± is half of the 95 % interval of the mean (Student's t). "
        f"Plan times: the worst seed's, {_threads(played)}."
    )


def _threads(played: list[dict]) -> str:
    threads = sorted({row["threads"] for row in played})
    return "threads of a plan: " + ", ".join("all cores" if count == 0 else f"{count}" for count in threads)
