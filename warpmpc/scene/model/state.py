# SPDX-License-Identifier: Apache-2.0
"""States of a plant and reports of a controller, as plain host values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .layout import Layout


@dataclass(frozen=True)
class State:
    """An observed state in Newton's conventions (quaternions x, y, z, w; free-joint twists of the centre of mass)."""

    joint_q: np.ndarray
    """Joint coordinates ``[nq]``, or ``[E, nq]`` for several environments [m, rad]."""
    joint_qd: np.ndarray
    """Joint velocities ``[nv]``, or ``[E, nv]`` [m/s, rad/s]."""
    time: float | np.ndarray | None = None
    """When it was observed [s], one for all environments or ``[E]``; without, one control after the last one."""
    act: np.ndarray | None = None
    """Activations of actuators with dynamics ``[na]``, or ``[E, na]``; the scene's start when left out."""
    mocap: np.ndarray | None = None
    """Poses of mocap bodies (x, y, z, qx, qy, qz, qw) ``[nm, 7]``, or ``[E, nm, 7]``; the scene's start when left
    out."""

    @classmethod
    def start(cls, layout: Layout) -> State:
        """The start state of a scene."""
        return cls(layout.joint_q.copy(), layout.joint_qd.copy(), act=layout.act.copy(), mocap=layout.mocap.copy())


PROPOSERS = ("samples", "best sample", "last plan")
"""Where a plan comes from that derivatives may have improved: the samples' mean, the best of them, the plan before."""


@dataclass(frozen=True)
class Info:
    """Result of one plan; plain floats."""

    time: float
    """Time of the observation [s]."""
    beta: float
    """Temperature β that weighed the samples next time."""
    eta: float
    """Effective number of samples η."""
    cost: float
    """Cost of the best sample; infinite when every sample diverged."""
    terms: dict[str, float]
    """Discounted cost of the best sample by term."""
    best: int
    """World of the best sample."""
    plan_ms: float
    """Wall time of the plan [ms]."""
    stages_ms: dict[str, float]
    """Wall time by stage [ms]."""
    diverged_worlds: int
    """Worlds whose physics blew up."""
    fallback: bool
    """Whether the safe command was sent because no sample survived."""
    proposer: str = "samples"
    """Where the plan comes from, one of :data:`PROPOSERS`."""
    lowered: float = 0.0
    """Share by which derivatives lowered its predicted cost."""


@dataclass
class Contact:
    """Contacts of robots and objects over an episode."""

    max_force: float = 0.0
    """Largest net force of a collision [N]: of robots with each other, of robots and objects with obstacles."""
    time: float = 0.0
    """Time in collisions [s]."""
    forces: dict[str, float] = field(default_factory=dict)
    """Largest net force by pair that collided [N]."""
    touches: dict[str, float] = field(default_factory=dict)
    """Largest net force by pair of an object and another object or a robot [N]: no collisions, for a task may be about
    them."""
