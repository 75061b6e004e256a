# SPDX-License-Identifier: Apache-2.0
"""The strategies by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ..registry import STRATEGIES
from ..scene.schema import Method
from .strategy import DerivativeStrategy, SamplingStrategy, Strategy
from .weighting import CrossEntropy, Mppi, PredictiveSampling, Tsallis


def register(name: str, make: Callable[..., Strategy]) -> None:
    """Add a strategy, for scene files (``planner.method``) and controllers.

    Args:
        name: The name.
        make: ``make(scene, layout, state, spline, limits, cost, *, seed)``, with the arguments of
            :class:`~warpmpc.planner.strategy.SamplingStrategy`.

    Raises:
        ValueError: If there is one of this name.
    """
    STRATEGIES.register(name, make)


for names, weighting in (
    ((Method.MPPI, Method.DIAL), Mppi.of),
    ((Method.PREDICTIVE_SAMPLING, Method.ILQS), lambda planner: PredictiveSampling()),
    ((Method.CEM, Method.ICEM), lambda planner: CrossEntropy(elites=planner.elites)),
    ((Method.TSALLIS,), lambda planner: Tsallis(elites=planner.elites, entropic_index=planner.entropic_index)),
):
    for name in names:
        register(str(name), partial(SamplingStrategy, weighting=weighting))
for name in (Method.GRADIENT_DESCENT, Method.ILQG):
    register(str(name), DerivativeStrategy)
