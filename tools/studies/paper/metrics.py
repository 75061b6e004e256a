# SPDX-License-Identifier: Apache-2.0
"""What is measured of a run, and how many runs become one figure with its 95 % interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from shared.intervals import Estimate, mean, rate


@dataclass(frozen=True)
class Metric:
    """One quantity of a run.

    Args:
        title: Column of the tables.
        unit: Unit, empty where there is none.
        of: The value of a run's record, None where it has none; truth values make a rate.
        digits: Decimals shown.
        rate: Whether it is a rate.
    """

    title: str
    unit: str
    of: Callable[[dict], float | bool | None]
    digits: int = 2
    rate: bool = False

    @property
    def heading(self) -> str:
        """Title with its unit; rates carry theirs in every value."""
        return self.title if self.rate or not self.unit else f"{self.title} [{self.unit}]"


def _when_reached(of: Callable[[dict], float | None]) -> Callable[[dict], float | None]:
    return lambda run: of(run) if run["result"]["success"] else None


def _final_cost(run: dict) -> float | None:
    return _cost(*run["measured"]["axes_error_m"][:2], run["result"]["final"]["yaw_error_rad"])


def _cost_then(run: dict) -> float | None:
    """The same after 8 s, or at the end of a run that ended before."""
    return _cost(*run["measured"]["then_m_rad"])


def _cost(x: float | None, y: float | None, yaw: float | None) -> float | None:
    """1.5 (|ex| + |ey|) + 0.01 |eψ|, metres and radians (Pezzato et al. 2025, Table II)."""
    return None if None in (x, y, yaw) else 1.5 * (abs(x) + abs(y)) + 0.01 * abs(yaw)


METRICS = {
    "success": Metric("reached", "%", lambda run: run["result"]["success"], 0, rate=True),
    "free": Metric("no collision", "%", lambda run: not run["result"]["collisions"]["max_force_N"], 0, rate=True),
    "time": Metric("time to goal", "s", lambda run: run["result"]["time_to_goal_s"]),
    "path": Metric("path length", "m", _when_reached(lambda run: run["measured"]["path_length_m"])),
    "jerk": Metric("squared jerk", "m²/s⁵", _when_reached(lambda run: run["measured"]["squared_jerk_m2_s5"]), 0),
    "rate": Metric("squared control rate", "", _when_reached(lambda run: run["measured"]["squared_control_rate"]), 0),
    "clearance": Metric("least clearance", "m", _when_reached(lambda run: run["measured"]["clearance_m"]), 3),
    "error": Metric("left at the end", "m", lambda run: run["result"]["final"]["position_error_m"]),
    "turns": Metric("goals in a row", "", lambda run: run["result"].get("reached"), 1),
    "solver": Metric("plan", "ms", lambda run: run["result"]["plan_ms"]["p50"], 1),
    "cost": Metric("final cost", "", _final_cost, 3),
    "cost_then": Metric("cost at 8 s", "", _cost_then, 3),
}
"""Metrics by name. Times, paths, jerks, rates and clearances are those of runs that reached the goal; a plan's wall
time is the median over its run."""


def estimate(metric: Metric, runs: Sequence[dict]) -> Estimate | None:
    """Sum runs up: Wilson's interval for rates, Student's t for means; None when no run has a value."""
    values = [value for run in runs if (value := metric.of(run)) is not None]
    if not values:
        return None
    return rate(sum(map(bool, values)), len(values)) if metric.rate else mean(values)


def shown(metric: Metric, found: Estimate | None) -> str:
    """An estimate as the tables show it: ``12.30 ± 0.84``, ``97 % [83, 99]``; a dash for none."""
    if found is None:
        return "–"
    if metric.rate:
        return f"{100 * found.value:.{metric.digits}f} % [{100 * found.low:.0f}, {100 * found.high:.0f}]"
    text = f"{found.value:.{metric.digits}f}"
    return text if found.low is None else f"{text} ± {found.high - found.value:.{metric.digits}f}"


def paper_shown(metric: Metric, figure: tuple[float, ...]) -> str:
    """A figure of the paper, with its standard deviation where there is one; rates as fractions."""
    if metric.rate:
        return f"{100 * figure[0]:g} %"
    return " ± ".join(f"{value:g}" for value in figure)
