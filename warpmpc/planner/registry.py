# SPDX-License-Identifier: Apache-2.0
"""The strategies by name; scene files name the shipped ones under ``planner.method``."""

from __future__ import annotations

from collections.abc import Callable

from ..scene.schema import Method
from .strategy import SamplingStrategy, Strategy

STRATEGIES: dict[str, Callable[..., Strategy]] = {}
"""What makes a strategy, by name: ``make(scene, layout, state, spline, limits, cost, *, seed)`` with the arguments of
:class:`~warpmpc.planner.strategy.SamplingStrategy`."""


def register(name: str, make: Callable[..., Strategy]) -> None:
    """Add a strategy.

    Raises:
        ValueError: If there is one of this name.
    """
    if name in STRATEGIES:
        raise ValueError(f"there is a strategy '{name}' already")
    STRATEGIES[name] = make


def find(name: str) -> Callable[..., Strategy]:
    """What makes the strategy of a name.

    Raises:
        ValueError: If there is none.
    """
    if name not in STRATEGIES:
        raise ValueError(f"no strategy '{name}'; there is: {', '.join(('auto', *STRATEGIES))}")
    return STRATEGIES[name]


for method in Method:
    register(str(method), SamplingStrategy)
