# SPDX-License-Identifier: Apache-2.0
"""Plans: what a planner hands out, stamped with absolute times.

Numbers that come back from the device after a plan, and what it expects: the rollout of one of its samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..scene.model.layout import GOAL, WORLD
from .splines import SplineKind, fitted_knots, spline_value

if TYPE_CHECKING:
    from ..scene.model.layout import Layout
    from ..scene.model.state import State
    from .feedback import Feedback


@dataclass(frozen=True)
class Plan:
    """Controls over time; immutable, and valid while the planner makes the next one.

    With several environments ``knots`` and ``times`` have a leading axis ``[E]``.
    """

    knots: np.ndarray
    """Spline control points ``[P, nu]``, in control units."""
    times: np.ndarray
    """When each knot stands, on the clock of the observations ``[P]`` [s]."""
    spline: SplineKind
    lower: np.ndarray
    """Lower limits of the controls ``[nu]``."""
    upper: np.ndarray
    """Upper limits of the controls ``[nu]``."""
    feedback: Feedback | None = None
    """Answer of the controls to states other than the planned ones; only plans of iLQG have it."""

    def __post_init__(self):
        # a scene's word for it, too: splines tell kinds apart by identity
        object.__setattr__(self, "spline", SplineKind(str(self.spline)))
        for array in (self.knots, self.times, self.lower, self.upper):
            array.setflags(write=False)

    def at(self, time: float | np.ndarray, state: State | None = None) -> np.ndarray:
        """Control ``[nu]``, or ``[E, nu]``, at a time [s]; before and after the plan its ends are held.

        Args:
            time: When; one for all, or one for each environment ``[E]``.
            state: What is observed then. With :attr:`feedback` the control answers it, u = ū(t) + K(t) (x ⊖ x̄(t))
                (Howell et al. 2022, Eq. 11); without, or without a state, it is the planned one.
        """
        if self.knots.ndim == 2:
            value = spline_value(self.spline, self.times, self.knots, float(time))
        else:
            rows = zip(self.times, self.knots, np.broadcast_to(time, len(self.knots)), strict=True)
            value = np.stack([spline_value(self.spline, times, knots, float(t)) for times, knots, t in rows])
        if self.feedback is not None and state is not None:
            value = value + self._answer(time, state)
        return np.minimum(np.maximum(value, self.lower), self.upper).astype(np.float32)

    def _answer(self, time: float | np.ndarray, state: State) -> np.ndarray:
        """Part that feedback adds to the controls ``[nu]``, or ``[E, nu]``."""
        if self.knots.ndim == 3:
            return self.feedback.correction(np.broadcast_to(np.asarray(time, dtype=float), len(self.knots)), state)
        act = None if state.act is None else np.asarray(state.act)[None]
        alone = replace(
            state, joint_q=np.asarray(state.joint_q)[None], joint_qd=np.asarray(state.joint_qd)[None], act=act
        )
        return self.feedback.correction(np.array([float(time)]), alone)[0]


def refitted(plan: Plan, kind: SplineKind, knot_time: np.ndarray) -> np.ndarray:
    """Knots ``[P, nu]``, or ``[E, P, nu]``, that a plan has on another spline.

    Args:
        knot_time: Times of its knots after the plan's first one ``[P]`` [s].

    Returns:
        The plan's own knots where they stand at the same times on the same spline, else those whose spline comes
        nearest to the plan's controls at these times in the least-squares sense.
    """
    own = plan.times - plan.times[..., :1]
    if kind is plan.spline and own.shape[-1] == len(knot_time) and np.allclose(own, knot_time, atol=1e-6):
        return plan.knots
    values = np.stack([plan.at(plan.times[..., 0] + t) for t in knot_time], axis=-2)
    return fitted_knots(kind, knot_time, values, knot_time)


@dataclass(frozen=True)
class PlanReport:
    """Outcome of a plan; views of the block that was copied back, overwritten by the next plan."""

    command: np.ndarray  # [E, nu]
    beta: np.ndarray  # [E]
    eta: np.ndarray  # [E]
    cost: np.ndarray  # [E] of the best sample, +inf when every sample diverged
    best: np.ndarray  # [E] sample
    diverged: np.ndarray  # [E] worlds whose physics failed
    overflow_halves: np.ndarray  # [2, E] capacity bits of all worlds together, the lower 16 first
    terms: np.ndarray  # [E, terms] of the best sample
    knots: np.ndarray  # [E, P, nu] of the plan
    offset: np.ndarray  # [E] time from the first knot to the present [s]

    @property
    def overflow(self) -> np.ndarray:
        """Capacity bits of all worlds together ``[E]``."""
        low, high = self.overflow_halves.astype(np.int64)
        return low | high << 16


@dataclass(frozen=True)
class Rollout:
    """States and controls of one sample over the horizon; slice 0 is the observed state.

    Copies: later plans do not change them.
    """

    times: np.ndarray
    """When each state is, on the clock of the observations ``[T+1]`` [s]."""
    joint_q: np.ndarray
    """Joint coordinates ``[T+1, nq]`` [m, rad]."""
    joint_qd: np.ndarray
    """Joint velocities ``[T+1, nv]`` [m/s, rad/s]."""
    body_q: np.ndarray
    """Poses of the bodies (x, y, z, qx, qy, qz, qw) ``[T+1, nb, 7]``, named by ``Controller.layout.body_name``."""
    control: np.ndarray
    """Control of every step ``[T, nu]``, named by ``Controller.layout.control_name``."""
    knots: np.ndarray
    """Spline control points that the controls come from ``[P, nu]``."""
    cost: float
    """Cost of the sample; infinite where it diverged."""
    layout: Layout
    """Names and places of joints, bodies and frames."""

    def frame(self, name: str) -> np.ndarray:
        """Poses of a frame (``robot/frame``, ``robot/link``, an object) ``[T+1, 7]``.

        Raises:
            SceneError: If there is no such frame.
            ValueError: If it is one of the task's poses: those are in ``Controller.task``.
        """
        index = self.layout.frame(name)
        body, local = int(self.layout.frame_body[index]), self.layout.frame_pose[index]
        if body <= GOAL:
            raise ValueError(f"'{name}' is a pose of the task, which stands still in a rollout: task['{name}']")
        if body == WORLD:
            return np.tile(local, (len(self.body_q), 1))
        poses = [wp.transform(*pose) * wp.transform(*local) for pose in self.body_q[:, body]]
        return np.array([[*pose.p, *pose.q] for pose in poses], dtype=np.float32)
