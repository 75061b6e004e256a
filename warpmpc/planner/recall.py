# SPDX-License-Identifier: Apache-2.0
"""Controls that a run sent before in states near the observed one, tried again.

Stored motions, of which those that began in a state near the observed one are tried among the samples.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..kernels.geometry.kinematics import BALL, FREE
from ..physics.runtime.files import read_npz
from ..scene.errors import SceneError
from ..scene.model.assets import resolve_asset
from .proposers import Proposer
from .splines import spline_value

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ..scene.model.layout import Layout
    from ..scene.model.state import State
    from ..scene.schema import Ancillary, Scene
    from .plan import PlanReport
    from .splines import Ask, Horizon

LEAST_SPREAD = 1e-6
"""Numbers that vary less over a file say nothing about what is near [m, rad, m/s, rad/s]."""


def motions(scene: Scene, layout: Layout, key: str, wanted: Ancillary, horizon: Horizon) -> tuple[int, Ask]:
    """Number of motions of a file that are tried, and the function that selects them.

    Raises:
        SceneError: If the file is missing or does not fit, or there is no such joint.
    """
    base = None if scene.path is None else scene.path.parent
    path = resolve_asset(wanted.motions, base=base, key=key, file=scene.path)
    try:
        with read_npz(path) as file:
            arrays = {name: np.asarray(file[name], float) for name in _NAMES if name in file.files}
        states, controls = _motions(arrays, layout, horizon)
    except (OSError, ValueError, TypeError) as error:
        raise SceneError(f"is no file of motions: {error}", key=key, file=scene.path, found=wanted.motions) from None
    if len(states) < wanted.nearest:
        nearest = key.replace("motions", "nearest")
        message = f"the file has {len(states)} motions"
        raise SceneError(message, key=nearest, file=scene.path, found=wanted.nearest)
    near = Nearness(layout, states, near_columns(layout, key.replace("motions", "joints"), wanted.joints))
    knots = horizon.knots(controls)

    def ask(state: State, task: Mapping[str, np.ndarray | float]) -> np.ndarray:
        distance = near(np.concatenate([state.joint_q, state.joint_qd]))
        return knots[np.argsort(distance, kind="stable")[: wanted.nearest]]

    return wanted.nearest, ask


class Nearness:
    """Distances of states from stored ones, every number counted by its spread over those.

    A quaternion is compared with the sign that brings it nearer, the angle of a joint that turns without end the short
    way round.

    Args:
        states: Stored joint coordinates and velocities ``[N, nq + nv]``.
        columns: Numbers that count.
    """

    def __init__(self, layout: Layout, states: np.ndarray, columns: np.ndarray):
        self._states, self._columns = states, columns
        starts = zip(layout.joint_type.tolist(), layout.joint_q_start.tolist(), strict=True)
        first = {int(BALL): 0, int(FREE): 3}
        self._quaternions = [slice(at + first[kind], at + first[kind] + 4) for kind, at in starts if kind in first]
        self._endless = endless_coordinates(layout, turning=True)
        spread = self._differences(states[0]).std(axis=0)
        self._scale = np.divide(1.0, spread, out=np.zeros_like(spread), where=spread > LEAST_SPREAD)

    def __call__(self, state: np.ndarray) -> np.ndarray:
        """Distances ``[N]`` of a state ``[nq + nv]``."""
        return np.linalg.norm((self._differences(state) * self._scale)[:, self._columns], axis=1)

    def _differences(self, state: np.ndarray) -> np.ndarray:
        out = self._states - state
        for part in self._quaternions:
            opposite = self._states[:, part] @ state[part] < 0.0
            out[opposite, part] = self._states[opposite, part] + state[part]
        out[:, self._endless] = (out[:, self._endless] + np.pi) % (2.0 * np.pi) - np.pi
        return out


_NAMES = ("joint_q", "joint_qd", "control", "time")


def _motions(arrays: dict[str, np.ndarray], layout: Layout, horizon: Horizon) -> tuple[np.ndarray, np.ndarray]:
    """States ``[N, nq + nv]`` and the controls ``[N, T, nu]`` that followed them."""
    missing = [name for name in _NAMES if name not in arrays]
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    control, time = arrays["control"], arrays["time"]
    if control.ndim not in (2, 3) or not len(control) or control.shape[-1] != layout.nu:
        raise ValueError(f"control is {list(control.shape)}, not [N, K, {layout.nu}] or, of a run, [N, {layout.nu}]")
    count = len(control)
    held = control.shape[1] if control.ndim == 3 else count
    recorded = control.ndim == 2  # a run has a state more than controls, the one it ended in
    for name, shape in (("joint_q", layout.nq), ("joint_qd", layout.nv)):
        if arrays[name].shape != (count + recorded, shape):
            raise ValueError(f"{name} is {list(arrays[name].shape)}, not [{count + recorded}, {shape}]")
    if time.shape != (held + recorded,) or np.any(np.diff(time) <= 0.0):
        raise ValueError(f"time is {list(time.shape)}, not {held + recorded} ascending numbers")
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise ValueError("it has numbers that are not finite")
    states = np.concatenate([arrays["joint_q"], arrays["joint_qd"]], axis=1)[:count]
    if recorded:
        at = time[:count, None] + horizon.time
        return states, control[holding(time[:count], at)]
    return states, control[:, holding(time, horizon.time)]


def endless_coordinates(layout: Layout, *, turning: bool) -> np.ndarray:
    """Coordinates of the joints that turn, or else slide, without end."""
    linear, angular = layout.joint_dof_dim.T
    turns = np.concatenate([np.arange(n) >= k for k, n in zip(linear, linear + angular, strict=True)])
    endless = (turns == turning) & (layout.dof_upper - layout.dof_lower > 1e3) & (layout.dof_coord >= 0)
    return layout.dof_coord[endless]


def holding(time: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Index of the control that acts at other times, of those that begin at ascending times; the ends are held."""
    early = 1e-6  # a step that begins with a control has it, however the two times were rounded
    return np.clip(np.searchsorted(time, at + early, side="right") - 1, 0, len(time) - 1)


def near_columns(layout: Layout, key: str, joints: Sequence[str] | None) -> np.ndarray:
    """Numbers of a state ``[nq + nv]`` that say what is near.

    Args:
        joints: Their names, all of them if None.
    """
    if joints is None:
        return np.arange(layout.nq + layout.nv)
    coords = [layout.joint(name, key=key) for name in joints]
    return np.concatenate([coords, layout.nq + np.flatnonzero(np.isin(layout.dof_coord, coords))])


APART = 0.1
"""Recalled moments are at least so far apart, as a share of the horizon: neighbours say the same."""

EARLY = 1e-6
"""Two times that are the same may differ by so much, however they were rounded [s]."""


class Recall(Proposer):
    """Controls that followed the moments of a run that were most like the present one, for as long as a plan lasts.

    One control is remembered for each plan: where plans are further apart than controls, the first one sent stands for
    all that were sent until the next plan.

    Args:
        envs: Number of environments E, each with its own memory.
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
