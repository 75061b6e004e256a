# SPDX-License-Identifier: Apache-2.0
"""Derivatives of MuJoCo's step at many states at once: every difference is a world that takes one step."""

from __future__ import annotations

import logging
import os
import threading
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
import warp as wp

from .model_numbers import ModelNumbers
from .outputs import unwritten_field
from .ready_batches import ReadyModels, put
from .runtime.thread_pool import thread_count
from .tangent import Tangent
from .unsupported import callbacks

if TYPE_CHECKING:
    from .batch import BatchRollout
    from .ready_batches import Ready

logger = logging.getLogger("warpmpc")

NEAR, FAR = 5e-5, 1e-3
"""Steps in coordinates [m or rad]. The far one loses twenty times less to rounding; where both disagree by more than
that, contacts begin or end between them, and the near one counts."""
SPEED, ACTIVATION = 2e-3, 1e-3
"""Steps in velocities [m/s or rad/s] and in activations, these as a share of what is beyond 1."""
EFFECT = 2e-3
"""What steps in controls do to velocities, about [m/s or rad/s]."""
SHARE = (1e-4, 1e-3, 1e-2)
"""Steps in controls as a share of half their range: the least, where that effect is not known, and the most."""
FASTEST = 10.0
"""Far steps and those of velocities and controls grow with the fastest velocity, as its rounding does, up to here."""
ROUNDING = 2.4e-7
"""What velocities of 1 lose, four times half the distance between two numbers there."""
APART = 3e-3
"""Share of the largest derivative by which near and far steps may disagree: rounding of contact forces."""
WORLDS = {"cpu": 1 << 13, "cuda": 1 << 17}
"""Worlds of one launch: what stays in a cache, and what fills a GPU."""


class Linear(NamedTuple):
    """Derivatives of steps; n = 2 nv + na numbers (dq, dv, da) of the tangent space, as ``mjd_transitionFD`` has it."""

    a: np.ndarray
    """∂x'/∂x ``[..., n, n]``."""
    b: np.ndarray
    """∂x'/∂u ``[..., n, nu]``."""
    c: np.ndarray | None
    """∂s/∂x ``[..., nsensordata, n]`` of the sensors before the step; None if not asked for."""
    d: np.ndarray | None
    """∂s/∂u ``[..., nsensordata, nu]``."""


def linearize(
    model: mujoco.MjModel,
    state: np.ndarray,
    control: np.ndarray,
    *,
    eps: float | None = None,
    centered: bool = True,
    sensors: bool = False,
    device: wp.DeviceLike = "cpu",
    threads: int = 0,
) -> Linear:
    """Differentiate steps at many states, as :func:`mujoco.mjd_transitionFD` does at one.

    Physics is in single precision; the same numbers give the same bits. The solver begins every difference of a state
    with the accelerations of that state. Numbers are NaN where a step fails.

    Args:
        model: The model.
        state: ``[..., 1+nq+nv+na]``, such as ``[W, T, ...]``: time, coordinates, velocities, activations.
        control: ``[..., nu]``; leading sizes may be 1. Mocap bodies are where the model has them.
        eps: Step of all differences; if None it depends on what is moved, and contacts that begin or end near a state
            have smaller steps.
        centered: Whether differences are centred; if not, they take half the time and have errors of first order.
        sensors: Whether sensors are differentiated, too.
        device: Warp device.
        threads: Threads on a CPU; 0 for one for each core.

    Raises:
        ValueError: If a size is wrong, ``eps`` is not positive, or the model has what this physics lacks.
    """
    if eps is not None and not 0.0 < eps < np.inf:
        raise ValueError(f"eps is {eps}, not a positive number")
    if lack := callbacks() or (unwritten_field(model, "sensordata") if sensors else None):
        raise ValueError(f"the physics of warpmpc has no {lack}")
    width = 1 + model.nq + model.nv + model.na
    state, control = (np.asarray(x, dtype=float) for x in (state, control))
    if (*state.shape[-1:], *control.shape[-1:]) != (width, model.nu):
        shapes = f"{state.shape} and {control.shape}, not [..., {width}] and [..., {model.nu}]"
        raise ValueError(f"state and control have the shapes {shapes}")
    lead = np.broadcast_shapes(state.shape[:-1], control.shape[:-1])
    x, u = (np.broadcast_to(y, (*lead, y.shape[-1])).reshape(-1, y.shape[-1]) for y in (state, control))
    with _shared.lock:
        most = WORLDS["cuda" if wp.get_device(device).is_cuda else "cpu"]
        out = _Differences(model, _shared.batches(model, threads, device), eps, most, centered, sensors)(x, u)
    n = 2 * model.nv + model.na
    parts = out[:, :n, :n], out[:, :n, n:], out[:, n:, :n], out[:, n:, n:]
    a, b, c, d = (part.reshape(*lead, *part.shape[1:]) for part in parts)
    return Linear(a, b, c, d) if sensors else Linear(a, b, None, None)


class _Shared:
    """Batches that stay ready between calls, which wait for each other; a fork begins anew, without their threads."""

    def __init__(self) -> None:
        self.lock, self._numbers = threading.Lock(), ModelNumbers()
        self._ready: dict[tuple[int, str], ReadyModels] = {}

    def batches(self, model: mujoco.MjModel, threads: int, device: wp.DeviceLike) -> Ready:
        where = thread_count(threads), str(device)
        return self._ready.setdefault(where, ReadyModels(*where)).of(self._numbers.of([model])[0], model)


_shared = _Shared()
os.register_at_fork(after_in_child=_shared.__init__)


class _Differences:
    """Differences of one model, of some kind.

    Columns are those of the state, of the controls, and, where steps are chosen, of the coordinates with near steps.
    Worlds of a state are one for each column forth, and one for each back, or one that is not moved.
    """

    def __init__(
        self, model: mujoco.MjModel, ready: Ready, eps: float | None, most: int, centered: bool, sensors: bool
    ):
        self._ready = ready
        self._model, self._eps, self._tangent, self._centered = model, eps, Tangent(model), centered
        self._fields = ("sensordata",) if sensors else ()
        self._n, self._twice = n, twice = self._tangent.size, 0 if eps else model.nv
        self._column = np.r_[: n + model.nu, :twice]
        self._columns, self._driven = len(self._column), np.arange(n, n + model.nu)
        self._moving = np.flatnonzero(self._column < n)
        self._back = self._columns if centered else 1
        self._worlds = self._columns + self._back
        self._most = max(1, most // max(1, self._worlds))
        limited = model.actuator_ctrllimited.astype(bool)
        lower, upper = model.actuator_ctrlrange.T
        self._half = np.where(limited, 0.5 * (upper - lower), 0.0)
        self._lower, self._upper = np.where(limited, lower, -np.inf), np.where(limited, upper, np.inf)

    def __call__(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Derivatives ``[N, n + sensors, n + nu]`` at states under controls ``[N, ...]``."""
        out = np.empty((len(x), self._n + len(self._fields) * self._model.nsensordata, self._n + self._model.nu))
        part = min(self._most, len(x))
        for first in range(0, len(x), part or 1):
            rows = np.minimum(np.arange(first, first + part), len(x) - 1)  # as many in the last launch
            out[rows] = self._part(*(_single(y[rows]) for y in (x, u)))
        return out

    def _part(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        model, columns, count = self._model, self._columns, len(x)
        speed = np.abs(x[:, 1 + model.nq : 1 + model.nq + model.nv]).max(axis=1, initial=1.0)
        still = self._run(x[:, None], u[:, None], np.zeros((count, model.nv)))
        warmstart = still.outputs.warmstart.numpy().repeat(self._worlds, axis=0)
        start, control = self._moved(x, u, self._steps(x, u, np.minimum(speed, FASTEST)))
        batch = self._run(start, control, warmstart)
        ends, read, lost = (
            array.numpy().reshape(count, self._worlds, -1)
            for array in (batch.state, batch.sensordata, batch.work.diverged)
        )
        failed = (lost[:, :columns, 0] != 0) | (lost[:, columns:, 0] != 0)
        wide = self._width(start[..., 1:], control, u)
        rise = self._rise(start[..., 1:], ends[..., 1:], wide)
        out = np.concatenate([rise, read[:, :columns] - read[:, columns:]], axis=-1)
        out /= np.where(failed, np.nan, wide)[..., None]
        if self._twice:
            self._choose(out, speed)
        return out[:, : self._n + model.nu].swapaxes(1, 2)

    def _steps(self, x: np.ndarray, u: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """How far every world is moved ``[N, worlds]``."""
        m, (least, usual, most) = self._model, SHARE
        activation = ACTIVATION * np.maximum(1.0, np.abs(x[:, 1 + m.nq + m.nv :]))
        gain = m.opt.timestep * m.actuator_acc0 * np.abs(m.actuator_gainprm[:, 0])
        known = (m.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_NONE)) & (gain > 0.0)
        half = np.where(self._half > 0.0, self._half, np.maximum(1.0, np.abs(u)))
        wanted = np.outer(speed, EFFECT / np.where(known, gain, np.inf)).clip(least * half, most * half)
        control = np.where(known, wanted, usual * half)
        state = np.outer(speed, np.repeat([FAR, SPEED], m.nv))
        forth = np.concatenate([state, activation, control, np.full((len(x), self._twice), NEAR)], axis=1)
        if self._eps:
            forth[...] = self._eps
        return np.concatenate([forth, -forth if self._centered else np.zeros((len(x), 1))], axis=1)

    def _moved(self, x: np.ndarray, u: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States and controls of all worlds ``[N, worlds, ...]``, as single precision has them."""
        start, control = (np.repeat(y[:, None], self._worlds, axis=1) for y in (x, u))
        column = np.resize(self._column, self._worlds)
        own, column = np.where(column < self._n, step, 0.0), np.where(column < self._n, column, 0)
        start[..., 1:] = _single(self._tangent.displace(x[:, 1:], column, own))
        for first in (0, self._columns)[: 1 + self._centered]:
            at = first + self._driven
            control[:, at, self._driven - self._n] = _single((u + step[:, at]).clip(self._lower, self._upper))
        return start, control

    def _width(self, start: np.ndarray, control: np.ndarray, u: np.ndarray) -> np.ndarray:
        """How far the two worlds of each column are apart ``[N, columns]``."""
        moving, driven = self._moving, self._driven
        wide, back = np.empty((len(u), self._columns)), self._columns + np.arange(self._columns) % self._back
        wide[:, moving] = self._tangent.along(start[:, moving], start[:, back[moving]], self._column[moving])
        apart = control[:, driven, driven - self._n] - control[:, back[driven], driven - self._n]
        wide[:, driven] = np.where((u < self._lower) | (u > self._upper) | (apart == 0.0), np.inf, apart)
        return wide

    def _rise(self, start: np.ndarray, end: np.ndarray, wide: np.ndarray) -> np.ndarray:
        """Differences of where the two worlds of each column end ``[N, columns, n]``."""
        m, columns = self._model, self._columns
        if m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
            return self._tangent.subtract(end[:, :columns], end[:, columns:])
        # coordinates follow from velocities: in double precision they lose nothing
        faster, dt = end[:, :columns, m.nq :] - end[:, columns:, m.nq :], m.opt.timestep
        rise = np.concatenate([dt * faster[..., : m.nv], faster], axis=-1)
        own = self._moving[self._column[self._moving] < m.nv]
        rise[:, own, self._column[own]] += wide[:, own]
        self._tangent.advance(rise, start, dt * end[..., m.nq : m.nq + m.nv])
        return rise

    def _choose(self, out: np.ndarray, speed: np.ndarray) -> None:
        """Take near steps in coordinates where far ones go beyond a contact's beginning or end."""
        far, near = out[:, : self._twice], out[:, -self._twice :]
        apart = np.abs(far - near)[..., : self._n].max(axis=2, initial=0.0)
        allowed = APART * np.abs(near[..., : self._n]).max(axis=(1, 2), initial=0.0) + ROUNDING * speed / NEAR
        np.copyto(far, near, where=~(apart <= allowed[:, None])[..., None])

    def _run(self, x: np.ndarray, u: np.ndarray, warmstart: np.ndarray) -> BatchRollout:
        batch = self._ready.batch(x.shape[0] * x.shape[1], 1, {}, fields=self._fields)
        for to, values in ((batch.work.initial, x), (batch.work.knots, u), (batch.outputs.warmstart, warmstart)):
            put(to, values)
        batch.run()
        if lost := int(np.count_nonzero(batch.work.overflow.numpy())):
            logger.warning("%d of %d worlds had more contacts at once than there is room for", lost, batch.worlds)
        return batch


def _single(values: np.ndarray) -> np.ndarray:
    """What single precision makes of numbers, in double precision."""
    return values.astype(np.float32).astype(float)
