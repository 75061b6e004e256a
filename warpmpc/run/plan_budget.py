# SPDX-License-Identifier: Apache-2.0
"""Plans that would take minutes on this machine, refused before the first one begins."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..scene.errors import SceneError
from ..scene.sizes import farthest, plan_sizes

if TYPE_CHECKING:
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")

LARGE = 500_000
"""Steps of all rollouts of a plan up to which nothing is measured."""
LONGEST = 10.0
"""Longest plan [s]."""
TOLD = 1.0
"""Plans that take longer are told of [s]."""
FEWEST, FIRST, MOST = 16, 256, 16384
"""Samples of the plans that are timed: at least, at first and at most."""
FIRST_STEPS = 65536
"""Steps of the rollouts of the first of them, at most, where that leaves samples enough."""
CLEAR = 0.05
"""Wall time of a plan that tells how long a larger one takes [s]."""


def require_short_plans(scene: Scene, time: Callable[[Scene], float], *, envs: int = 1) -> None:
    """Refuse a scene whose plans would take minutes here.

    Large plans alone are measured: one of few samples and a single iteration is timed, and what it takes grows with the
    steps of all rollouts.

    Args:
        time: Wall time of a plan of a scene [s].

    Raises:
        SceneError: If they would; it names the key that is farthest from what is usual.
    """
    sizes = plan_sizes(scene)
    steps = math.prod(sizes.values())
    if steps * envs <= LARGE:
        return
    count = min(sizes["samples"], max(FEWEST, min(FIRST, FIRST_STEPS // (sizes["horizon"] * min(sizes["domains"], 2)))))
    while (seconds := time(_smaller(scene, count))) < CLEAR and 4 * count <= min(sizes["samples"], MOST):
        count *= 4
    whole = seconds * steps / math.prod(plan_sizes(_smaller(scene, count)).values())
    if whole > LONGEST:
        name = farthest(sizes)
        what = f"a plan would take about {_duration(whole)} on this machine, more than {_duration(LONGEST)}: lower this"
        raise SceneError(what, key=f"planner.{name}", file=scene.path, found=sizes[name])
    if whole > TOLD:
        logger.info("a plan takes about %s on this machine", _duration(whole))


def _smaller(scene: Scene, samples: int) -> Scene:
    """The same scene with few samples, which are rolled out once."""
    planner = scene.planner
    small = {"samples": samples, "domains": min(planner.domains, 2), "iterations": 1, "decay": 1.0}
    return scene.model_copy(update={"planner": planner.model_copy(update=small)})


def _duration(seconds: float) -> str:
    """A time in its largest unit."""
    for unit, length in (("days", 86400.0), ("hours", 3600.0), ("min", 60.0)):
        if seconds >= length:
            return f"{seconds / length:.2g} {unit}"
    return f"{seconds:.2g} s"
