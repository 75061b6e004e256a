# SPDX-License-Identifier: Apache-2.0
"""Many episodes in a sentence."""

from __future__ import annotations

import math
import statistics
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..run.result import EpisodeResult


def summary(results: Sequence[EpisodeResult]) -> str:
    """Number of successful episodes, and the mean ± standard deviation of their times; else of their costs."""
    if results[0].success is None:
        costs = [result.mean_cost for result in results if math.isfinite(result.mean_cost)]
        text = f"{sum(r.passed for r in results)} of {len(results)} ran to the timeout{_in_a_row(results)}"
        spread = f" ± {statistics.stdev(costs):.4g}" if len(costs) > 1 else ""
        return f"{text}; mean cost {statistics.mean(costs):.4g}{spread}" if costs else text
    times = [result.time_to_goal for result in results if result.time_to_goal is not None]
    text = f"{len(times)} of {len(results)} reached the goal" + _in_a_row(results)
    if not times:
        return text
    spread = f" ± {statistics.stdev(times):.2f}" if len(times) > 1 else ""
    return f"{text}; time to goal {statistics.mean(times):.2f}{spread} s"


def _in_a_row(results: Sequence[EpisodeResult]) -> str:
    """Number of phases of a task in parts that came to their end."""
    reached = [result.reached for result in results if result.reached is not None]
    if not reached:
        return ""
    return f"; phases reached: median {statistics.median(reached):g}, {min(reached)} to {max(reached)}"
