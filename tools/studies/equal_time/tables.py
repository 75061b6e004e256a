# SPDX-License-Identifier: Apache-2.0
"""What came of the episodes, as figures and as tables in Markdown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import numpy as np
from shared.intervals import mean, rate
from shared.machine import machine

from studies.paper.metrics import METRICS, shown
from warpmpc.loop.run.workers import FinishedJobs

from .cells import Cell


def summary(cells: list[Cell], records: FinishedJobs) -> list[dict]:
    """Figures of every task and strategy of which there are any, from its episodes."""
    rows = []
    for (task, strategy), group in _grouped(cells).items():
        done = [found for cell in group if (found := records.by_key.get(cell.key("run")))]
        if not done:
            continue
        costs = [record["cost"] for record in done if record["cost"] is not None]
        rows.append(
            {
                "task": task,
                "strategy": strategy,
                "samples": group[0].samples,
                "plan_ms": float(np.median([record["plan_ms"] for record in done])),
                "seeds": len(done),
                "diverged": len(done) - len(costs),
                "cost": asdict(mean(costs)) if costs else None,
                "reached": asdict(rate(sum(record["reached"] is not None for record in done), len(done))),
                "costs": costs,
                "times": [record["reached"] for record in done],
            }
        )
    return rows


def _grouped(cells: list[Cell]) -> dict[tuple[str, str], list[Cell]]:
    groups: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.task, cell.strategy), []).append(cell)
    return groups


def tables(rows: list[dict], *, ms: float, seconds: float) -> str:
    """Three tables in Markdown: cost, success, and what a plan was; of each task the lowest cost is bold."""
    here, by_cell = machine(), {(row["task"], row["strategy"]): row for row in rows}
    tasks, strategies = (list(dict.fromkeys(row[name] for row in rows)) for name in ("task", "strategy"))
    seeds = max((row["seeds"] for row in rows), default=0)

    def cost(row: dict) -> str:
        found = row["cost"]
        if found is None:
            return "–"
        spread = "" if found["low"] is None else f" ± {found['high'] - found['value']:.2g}"
        lowest = min(by_cell[key]["cost"]["value"] for key in by_cell if key[0] == row["task"] and by_cell[key]["cost"])
        text = f"{found['value']:.3g}{spread}"
        return f"**{text}**" if found["value"] == lowest else text

    def reached(row: dict) -> str:
        return shown(METRICS["success"], rate(round(row["reached"]["value"] * row["seeds"]), row["seeds"]))

    def plan(row: dict) -> str:
        return f"{row['samples']}, {row['plan_ms']:.1f} ms"

    def table(show: Callable[[dict], str]) -> list[str]:
        lines = [f"| task | {' | '.join(strategies)} |", "|---" * (len(strategies) + 1) + "|"]
        for task in tasks:
            cells = [show(by_cell[task, name]) if (task, name) in by_cell else "–" for name in strategies]
            lines.append(f"| `{task}` | {' | '.join(cells)} |")
        return lines

    what = f"Plans of {ms:g} ms on one thread, {seeds} seeds, episodes of at most {seconds:g} s, on {here['cpu']}."
    few = {f"{row['task']}, {row['strategy']}: {row['seeds']}" for row in rows if row["seeds"] < seeds}
    lost = [f"{row['task']}, {row['strategy']}: {row['diverged']}" for row in rows if row["diverged"]]
    notes = [f"Fewer seeds: {'; '.join(sorted(few))}."] * bool(few) + [f"Diverged: {'; '.join(lost)}."] * bool(lost)
    parts = [[what, *notes], ["Mean cost of a control step:"], table(cost), ["Seeds that reached the goal:"]]
    parts += [
        table(reached),
        ["Samples, or iterations without any, and the median time of a plan in closed loop:"],
        table(plan),
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"
