# SPDX-License-Identifier: Apache-2.0
"""State of a session at one moment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from ..controller.rollout_paths import RolloutPaths
    from .forecast import Forecast
    from .foresight import Foreseen
    from .plan_rate import PlanRate


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """Everything that is shown after a step; arrays are copies."""

    source: str
    """Scene and variant: what is listed begins anew when they change."""
    build: int
    """Counts plants built: what is drawn begins anew when it changes."""
    episode: int
    """Counts resets: curves begin anew when it changes."""
    time: float
    """Simulated time [s]."""
    steps: int
    body_q: np.ndarray
    """Poses of the bodies ``[nb, 7]``."""
    joint_q: np.ndarray
    """Joint coordinates ``[nq]``."""
    sensor: np.ndarray
    """Numbers of all sensors ``[ns]``."""
    poses: dict[str, np.ndarray]
    """Goal, targets and movable obstacles ``[7]``."""
    values: dict[str, float]
    """Weights and scalars of the task by name, parameters of norms by key (``cost.head.norm.p``)."""
    paths: RolloutPaths | None
    """Best rollout and fan; None without a plan."""
    forecast: Forecast | None
    """Cost and controls that the best rollout expects; None without a plan."""
    forces: np.ndarray
    """Net forces of the plant's pairs ``[pairs, 3]`` [N]."""
    pull: np.ndarray | None
    """Ends of the spring that pulls at a body ``[2, 3]`` [m]; None without."""
    control: np.ndarray
    cost: float
    """Cost of the best rollout; NaN without a plan."""
    eta: float
    beta: float
    plan_ms: float
    plans: float
    """Plans made for each of the last controls; NaN without."""
    rate: PlanRate
    """How many plans are made, and how long they take."""
    age: float
    """Age of the plan in use: time since the observation that it was made from [s]; NaN without."""
    foreseen: Foreseen | None
    """The newest prediction beside what came; None before the first."""
    status: str
    """Status in words."""
    paused: bool
    planning: bool
    controlling: bool
    lock_step: bool
    recording: str
    """File that is recorded to; empty without."""
    message: str
    """Error of the last change that could not be made; empty when all is well."""
