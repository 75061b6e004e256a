# SPDX-License-Identifier: Apache-2.0
"""Observations of a controller: the newest finite numbers of every environment in one block, and when it was."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...scene.model.state import State

if TYPE_CHECKING:
    from ...scene.model.layout import Layout


class Observation:
    """The last finite observation of every environment, the scene's start before there is one.

    Args:
        dt: Time between observations that do not say when they are [s].
    """

    block: np.ndarray
    """Joint coordinates, joint velocities, activations and mocap poses side by side ``[E, nq + nv + na + 7 nm]``."""
    fresh: np.ndarray
    """True where the newest observation was finite ``[E]``."""
    seen: np.ndarray
    """True where there has been a finite one ``[E]``."""
    now: np.ndarray
    """Time of the newest observation, finite or not, ``[E]`` [s]; NaN before the first."""
    elapsed: np.ndarray
    """Time since the finite observation before, zero for the first and where there is none now, ``[E]`` [s]."""
    planned: np.ndarray
    """Time of the newest finite observation ``[E]`` [s], NaN before the first."""

    def __init__(self, layout: Layout, envs: int, dt: float):
        self._layout, self._envs, self._dt = layout, envs, dt
        widths = (layout.nq, layout.nv, layout.na, 7 * layout.nm)
        ends = np.cumsum(widths).tolist()
        self._part = {name: slice(end - n, end) for name, end, n in zip(_NAMES, ends, widths, strict=True)}
        self._shape = {"act": (layout.na,), "mocap": (layout.nm, 7)}
        speed = layout.activation_speed
        self._follows = np.flatnonzero(speed >= 0)
        self._followed = layout.nq + speed[self._follows]
        self._start = np.tile(
            np.concatenate([layout.joint_q, layout.joint_qd, layout.act, layout.mocap.ravel()]).astype(np.float32),
            (envs, 1),
        )
        self.forget()

    def forget(self) -> None:
        """Go back to having seen nothing."""
        self.block, self._newest = self._start.copy(), self._start.copy()
        self.fresh, self.seen = np.zeros(self._envs, dtype=bool), np.zeros(self._envs, dtype=bool)
        self.now, self.planned = np.full(self._envs, np.nan), np.full(self._envs, np.nan)
        self.elapsed = np.zeros(self._envs)

    def resume(self, time: np.ndarray) -> None:
        """Count from a time on, one for all environments or ``[E]`` [s], as if something had been observed then."""
        self.now[:], self.planned[:] = time, time

    @property
    def joint_q(self) -> np.ndarray:
        """Joint coordinates ``[E, nq]``."""
        return self.block[:, self._part["joint_q"]]

    @property
    def joint_qd(self) -> np.ndarray:
        """Joint velocities ``[E, nv]``."""
        return self.block[:, self._part["joint_qd"]]

    def newest(self, *, many: bool) -> State:
        """The newest observation with what it left out, copied.

        Args:
            many: Whether with a leading axis ``[E]``.
        """
        row = (self.block if self.fresh.all() else self._newest).copy()
        act, mocap = (row[:, self._part[name]].reshape(self._envs, *shape) for name, shape in self._shape.items())
        q, qd = (row[:, self._part[name]] for name in _NAMES[:2])
        if many:
            return State(q, qd, time=self.now.copy(), act=act, mocap=mocap)
        return State(q[0], qd[0], time=float(self.now[0]), act=act[0], mocap=mocap[0])

    @property
    def last(self) -> np.ndarray:
        """Time of the newest finite observation ``[E]`` [s], zero before the first."""
        return np.where(np.isnan(self.planned), 0.0, self.planned)

    def take(self, state: State) -> None:
        """Take in a state; what it leaves out is as it was.

        Raises:
            ValueError: If it has the wrong shape.
        """
        newest = self._newest
        self._take_joints(state)
        for name, shape in self._shape.items():
            part, value = self._part[name], getattr(state, name)
            if value is None:
                newest[:, part] = self.block[:, part]
                continue
            value = np.asarray(value, dtype=np.float32)
            if value.shape != (self._envs, *shape) and not (self._envs == 1 and value.shape == shape):
                lead = [self._envs] if self._envs > 1 else []
                raise ValueError(f"a state of this scene has {name} {[*lead, *shape]}, not {list(value.shape)}")
            newest[:, part] = value.reshape(self._envs, -1)
        if state.act is None and len(self._follows):  # set points of speeds are the speeds themselves
            newest[:, self._part["act"].start + self._follows] = newest[:, self._followed]
        self.fresh = np.isfinite(newest).all(axis=1)
        if self.fresh.all():
            self.block, self._newest = newest, self.block
        else:
            self.block[self.fresh] = newest[self.fresh]
        self.seen |= self.fresh
        self._take_time(state.time)

    def _take_joints(self, state: State) -> None:
        layout, envs = self._layout, self._envs
        q, qd = np.asarray(state.joint_q), np.asarray(state.joint_qd)
        many = (q.shape, qd.shape) == ((envs, layout.nq), (envs, layout.nv))
        if not many and not (envs == 1 and (q.shape, qd.shape) == ((layout.nq,), (layout.nv,))):
            lead = f"{envs}, " if envs > 1 else ""
            raise ValueError(
                f"a state of this scene has joint_q [{lead}{layout.nq}] and joint_qd [{lead}{layout.nv}], "
                f"not {list(q.shape)} and {list(qd.shape)}"
            )
        self._newest[:, self._part["joint_q"]], self._newest[:, self._part["joint_qd"]] = q, qd

    def _take_time(self, time: float | np.ndarray | None) -> None:
        """Set the times; a clock that runs back stands still."""
        now = np.empty(self._envs)
        now[:] = np.nan_to_num(self.now + self._dt) if time is None else time
        self.now = now
        self.elapsed = np.fmax(now - self.planned, 0.0)  # zero where nothing was planned before
        if self.fresh.all():
            self.planned = now
        else:
            self.elapsed[~self.fresh] = 0.0
            self.planned = np.where(self.fresh, now, self.planned)


_NAMES = ("joint_q", "joint_qd", "act", "mocap")
