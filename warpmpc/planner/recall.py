# SPDX-License-Identifier: Apache-2.0
"""Controls that a run sent before in states near the observed one, tried again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..kernels.geometry.kinematics import FREE
from ..scene.errors import SceneError
from .motions import Nearness, endless_coordinates, holding, near_columns
from .proposers import Proposer
from .splines import spline_value

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ..model.layout import Layout
    from ..model.state import State
    from ..scene.schema import Ancillary, Scene
    from .horizon import Horizon
    from .report import PlanReport

APART = 0.1
"""Recalled moments are at least so far apart, as a share of the horizon: neighbours say the same."""

EARLY = 1e-6
"""Two times that are the same may differ by so much, however they were rounded [s]."""


class Recall(Proposer):
    """Controls that followed the moments of a run that were most like the present one, for as long as a plan lasts.

    One control is remembered for each plan: where plans are further apart than controls, the first one sent stands for
    all that were sent until the next plan.

    Args:
        envs: Number of environments E, each with a memory of its own.

    Raises:
        SceneError: If there is no such joint, or the memory is shorter than a plan.
    """

    def __init__(self, scene: Scene, layout: Layout, key: str, wanted: Ancillary, horizon: Horizon, envs: int):
        super().__init__(wanted.nearest * len(wanted.splice))
        self._layout, self._horizon, self._nearest = layout, horizon, wanted.nearest
        self._splices = [np.searchsorted(horizon.time, share * horizon.time[-1]) for share in wanted.splice]
        self._columns = near_columns(layout, f"{key}.joints", wanted.joints)
        if wanted.joints is None:
            self._columns = np.setdiff1d(self._columns, _unbounded_coordinates(layout))
        least = float(horizon.time[-1]) + scene.timing.control_dt
        if wanted.recall < least:
            message = f"is shorter than what a plan of {least:g} s needs, so that nothing is ever known; give more"
            raise SceneError(message, key=f"{key}.recall", file=scene.path, found=wanted.recall)
        plans = int(np.ceil(wanted.recall / scene.timing.control_dt))
        self._memories = [_Memory(plans, scene.timing.control_dt, layout) for _ in range(envs)]

    def reset(self) -> None:
        """Forget everything."""
        for memory in self._memories:
            memory.forget()

    def ask(
        self, e: int, state: State | None, task: Mapping[str, np.ndarray | float], last: PlanReport
    ) -> np.ndarray | None:
        """Knots ``[n, P, nu]`` to try from a state on, which is remembered, n at most :attr:`count`.

        There are none as long as no whole horizon is remembered. What is sent where there is no state to plan from is
        not remembered.
        """
        memory, horizon = self._memories[e], self._horizon
        began = memory.began
        memory.keep(_sent(last, e))
        if state is None:
            return None
        memory.see(state)
        known = int(np.searchsorted(memory.time, state.time - horizon.time[-1] - EARLY))  # and all that followed
        if not known:
            return None
        near = Nearness(self._layout, memory.state[:known], self._columns)
        at = self._moments(near(np.concatenate([state.joint_q, state.joint_qd])), memory.time[:known])
        held = holding(memory.time, memory.time[at, None] + horizon.time)
        recalled = memory.control[held]
        samples = np.tile(recalled, (len(self._splices), 1, 1))
        if any(self._splices):
            plan = self._rest(last, e, state.time - began)
            for i, steps in enumerate(self._splices):
                samples[i * len(at) : (i + 1) * len(at), :steps] = plan[:steps]
        return horizon.knots(samples)

    def _moments(self, distance: np.ndarray, time: np.ndarray) -> np.ndarray:
        """The nearest moments, none of them close to another in time."""
        apart, found = APART * self._horizon.time[-1], []
        while len(found) < self._nearest and np.isfinite(distance.min()):
            found.append(int(distance.argmin()))
            distance[np.abs(time - time[found[-1]]) <= apart] = np.inf
        return np.array(found)

    def _rest(self, last: PlanReport, e: int, elapsed: float) -> np.ndarray:
        """The controls ``[T, nu]`` of the last plan from now on."""
        horizon, now = self._horizon, elapsed + float(last.offset[e])
        knots = last.knots[e]
        return np.stack([spline_value(horizon.kind, horizon.knot_time, knots, now + t) for t in horizon.time])


class _Memory:
    """The last observed states of a run, and the controls that were sent in them.

    Args:
        count: How many are kept.
        control_dt: Time of a control [s]: a clock that is set back by less is read unevenly, and starts no run.
    """

    def __init__(self, count: int, control_dt: float, layout: Layout):
        self._control_dt, self._count, self._states = control_dt, count, layout.nq + layout.nv
        self._rows = np.empty((2 * count, 1 + self._states + layout.nu))  # moved to the front when it is full
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._end = 0
        self._open = False  # whether there is a state whose control is not known yet
        self.began = np.nan
        """Time of the state that was seen last [s], NaN before the first."""

    @property
    def _kept(self) -> np.ndarray:
        return self._rows[max(self._end - self._count, 0) : self._end]

    @property
    def time(self) -> np.ndarray:
        """Times ``[N]`` [s], ascending."""
        return self._kept[:, 0]

    @property
    def state(self) -> np.ndarray:
        """Joint coordinates and velocities ``[N, nq + nv]``."""
        return self._kept[:, 1 : 1 + self._states]

    @property
    def control(self) -> np.ndarray:
        """Control that was sent from then on, to the next one ``[N, nu]``."""
        return self._kept[:, 1 + self._states :]

    def keep(self, sent: np.ndarray | None) -> None:
        """Remember what was sent in the state that was seen last, once.

        Args:
            sent: Control ``[nu]``, None where it was not the plan's.
        """
        if self._open and sent is not None:
            if self._end == len(self._rows):
                self._rows[: self._count] = self._rows[self._count :]
                self._end = self._count
            self._rows[self._end] = [self.began, *self._state, *sent]
            self._end += 1
        self._open = False

    def see(self, state: State) -> None:
        """Take in the state that is observed now; one from more than a control before the last begins a run anew."""
        if state.time < self.began - self._control_dt:
            self.forget()
        while self._end and self._rows[self._end - 1, 0] >= state.time:
            self._end -= 1  # planned for again
        self.began, self._state, self._open = state.time, np.concatenate([state.joint_q, state.joint_qd]), True


def _sent(last: PlanReport, e: int) -> np.ndarray | None:
    """Control that an environment was sent, None where no sample survived."""
    return last.command[e] if np.isfinite(last.cost[e]) else None


def _unbounded_coordinates(layout: Layout) -> np.ndarray:
    """Coordinates that need not come back: positions of floating bodies and of joints that slide without end."""
    first = [int(at) for kind, at in zip(layout.joint_type, layout.joint_q_start, strict=False) if kind == int(FREE)]
    free = [at + i for at in first for i in range(3)]
    return np.concatenate([free, endless_coordinates(layout, turning=False)]).astype(int)
