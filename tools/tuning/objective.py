# SPDX-License-Identifier: Apache-2.0
"""What an episode is worth to a tuning: seconds, less is better."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from warpmpc import Scene

GRAZE_FORCE = 5.0
"""Net force up to which a touched obstacle counts as grazed [N]."""
GRAZE_TIME = 0.1
"""Time in contact up to which it does [s]."""
FARTHEST = 2.0
"""Final errors beyond this many start errors count as this many."""


def score(run: dict, scene: Scene, *, contact_penalty: float) -> float:
    """Value of an episode [s].

    A success is worth its time to the goal. A failure is worth at least twice the timeout, plus the timeout times the
    share of the start error that is left, in position and, where success asks for it, in orientation (of π). So a near
    miss is better than a far one, and any success better than both. Contact beyond a graze adds a penalty.

    Args:
        run: What :func:`jobs.run_job` returned.
        scene: The episode's scene.
        contact_penalty: Price of contact beyond a graze [s].
    """
    result, measured = run["result"], run["measured"]
    contact = result["collisions"]
    hard = contact["max_force_N"] > GRAZE_FORCE and contact["time_in_contact_s"] > GRAZE_TIME
    price = contact_penalty * hard
    if result["success"]:
        return result["time_to_goal_s"] + price
    tolerance = scene.success.distance or max(scene.success.position or (0.0,))
    left = _share(result["final"]["position_error_m"], max(measured["start_position_error_m"], tolerance, 1e-3))
    if scene.success.yaw is not None:
        left += _share(result["final"]["yaw_error_rad"], math.pi)
    elif scene.success.rotation is not None:
        left += _share(measured["rotation_error_rad"], math.pi)
    return scene.timing.timeout * (2.0 + left) + price


def _share(error: float | None, whole: float) -> float:
    """What part of a whole is left; an error without a value is the worst."""
    return FARTHEST if error is None else min(error / whole, FARTHEST)
