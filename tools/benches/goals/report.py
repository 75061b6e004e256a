# SPDX-License-Identifier: Apache-2.0
"""How the rows of the table of goals are told."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from .rows import PLAN

_FLOOR = {"newton": "MuJoCo Warp's graph", "mujoco": "mujoco.rollout"}


def told(result: dict) -> str:
    """A row's figures in one line."""
    parts = []
    if "plan_ms" in result:
        parts.append(f"{_pair(result['plan_ms'])} ms (p50 / p99 of {result['plans']})")
    if "ratio" in result:
        parts.append(f"{result['ratio']:.1f} times as fast, {result['fused_us']:.3g} µs a world-step")
    parts.append(verdict(result))
    if "floor_ms" in result:
        other = result["other"]
        parts.append(
            f"{_FLOOR[other]} alone {_pair(result['floor_ms'])}, plans of {other} {_pair(result['other_plan_ms'])}"
        )
    parts.append(f"took {result['took_s']:.0f} s")
    return ", ".join(filter(None, parts))


def verdict(result: dict) -> str:
    """Whether the goal was met, by the median, and an error if there was one."""
    error = f"FAILED: {result['error']}" if "error" in result else ""
    value = result.get("plan_ms", {}).get("p50") if result["kind"] == PLAN else result.get("ratio")
    goal = result["goal"]
    if value is None or goal is None:
        return error
    good = value <= goal if result["kind"] == PLAN else value >= goal
    by = abs(value - goal) / goal
    text = f"goal {goal:g}: {'met' if good else f'missed by {100 * by:.0f} %'}"
    return f"{text} ({error})" if error else text


def show(results: list[dict], console: Console) -> None:
    """All rows in one table."""
    heads = ("row", "on", "p50 / p99 in ms, or ratio", "goal", "physics alone", "other engine's plan")
    table = Table(*heads, box=None)
    for r in results:
        figure = _pair(r["plan_ms"]) if "plan_ms" in r else f"{r['ratio']:.1f} ×" if "ratio" in r else "-"
        others = [_pair(r[key]) if key in r else "-" for key in ("floor_ms", "other_plan_ms")]
        table.add_row(r["title"], r["where"], figure, verdict(r), *others)
    console.print(table)


def _pair(times: dict[str, float]) -> str:
    return f"{times['p50']:.3g} / {times['p99']:.3g}"
