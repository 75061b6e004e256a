# SPDX-License-Identifier: Apache-2.0
"""``mujoco.rollout`` with worlds in the lanes of a register: the same functions, arguments and arrays.

    from warpmpc.physics import rollout  # in place of: from mujoco import rollout

    state, sensordata = rollout.rollout(model, data, initial_state, control)

MuJoCo rolls out models that have more than this physics, with one line in the log. Rollouts are in single
precision; states and sensor readings are handed out as doubles.
"""

from __future__ import annotations

import atexit
import ctypes
import logging
import os
import threading
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco
import mujoco.rollout
import numpy as np
import warp as wp

from .model_numbers import ModelNumbers
from .outputs import unwritten_field
from .ready_batches import ReadyModels, check_sizes, units
from .unsupported import callbacks, missing

logger = logging.getLogger("warpmpc")
_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)
_POSITION, _TURN = int(mujoco.mjtState.mjSTATE_MOCAP_POS), int(mujoco.mjtState.mjSTATE_MOCAP_QUAT)


def lacking(model: mujoco.MjModel) -> str | None:
    """Return what a model has and these rollouts lack, in a few words; None if there is nothing."""
    return unwritten_field(model, "sensordata") or missing(model)


class Rollout(mujoco.rollout.Rollout):
    """Rolls controls out, as :class:`mujoco.rollout.Rollout`.

    Calls from several threads wait for each other; rollouts of different objects run side by side.

    Args:
        nthread: Threads; 0 or None for the calling one alone. More than the cores of this process are not used.
        device: Warp device of the rollouts.
        fall_back: Whether MuJoCo rolls out what this physics lacks. If not, that is an error.
    """

    def __init__(self, *, nthread: int | None = None, device: wp.DeviceLike = "cpu", fall_back: bool = True):
        self.nthread = nthread or 0
        self.rollout_ = _Native(self.nthread, device, fall_back=fall_back)

    @property
    def diverged(self) -> np.ndarray | None:
        """Worlds of the last rollout whose state or controls were no numbers, or beyond 1e10 ``[W]``.

        They stay where they were before that step. None where MuJoCo rolled out.
        """
        return self.rollout_.diverged

    def close(self) -> None:
        """End the threads, after a rollout that another thread is in; later ones are an error."""
        self.rollout_.close()


_natives: weakref.WeakSet[_Native] = weakref.WeakSet()


class _Native:
    """Receiver of the arrays that MuJoCo's class has checked.

    Args:
        nthread: Threads.
        device: Warp device.
        fall_back: Whether MuJoCo rolls out what this physics lacks.
    """

    def __init__(self, nthread: int, device: wp.DeviceLike, *, fall_back: bool):
        self._nthread, self._fall_back, self._device = nthread, fall_back, device
        self._threads = max(1, min(nthread, len(os.sched_getaffinity(0))))
        self._told: set[str] = set()
        self._closed = False
        self.diverged: np.ndarray | None = None
        self._begin()
        _natives.add(self)

    def _begin(self) -> None:
        """Begin with nothing ready."""
        self._lock, self._mujoco = threading.Lock(), None
        self._numbers = ModelNumbers()
        self._ready = ReadyModels(self._threads, self._device)
        self._lack: dict[bytes, str | None] = {}

    def forked(self) -> None:
        """Begin anew in a fork, which has neither the threads nor the owners of locks."""
        if self._mujoco is not None:  # its end would wait for its threads
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._mujoco))
        self._begin()

    @property
    def _theirs(self) -> object:
        """MuJoCo's own receiver."""
        if self._mujoco is None:
            self._mujoco = mujoco.rollout.Rollout(nthread=self._nthread).rollout_
        return self._mujoco

    def close(self) -> None:
        """Let go of everything."""
        with self._lock:
            self._closed, self._mujoco = True, None
            self._ready.clear()

    def rollout(self, *arguments: object, **options: object) -> None:
        """Roll out; the arguments are those of MuJoCo's native function.

        Raises:
            RuntimeError: After :meth:`close`.
            ValueError: If the arguments do not fit each other, or this physics lacks what is asked for and MuJoCo is
                not to step in.
        """
        with self._lock:
            if self._closed:
                raise RuntimeError("rollout requested after thread pool shutdown")
            self._rollout(*arguments, **options)

    def _rollout(
        self,
        model: mujoco.MjModel | Sequence[mujoco.MjModel],
        data: Sequence[mujoco.MjData],
        nstep: int,
        control_spec: int,
        initial_state: np.ndarray,
        initial_warmstart: np.ndarray | None = None,
        control: np.ndarray | None = None,
        state: np.ndarray | None = None,
        sensordata: np.ndarray | None = None,
        chunk_size: int | None = None,
    ) -> None:
        if nstep < 0:
            raise ValueError("nstep must be non-negative")
        if chunk_size is not None and chunk_size <= 0:
            raise ValueError("chunk_size must be a positive integer")
        worlds = len(initial_state)
        models = [model] if isinstance(model, mujoco.MjModel) else list(model)[:worlds]
        self._theirs.rollout(models[:1], data, 0, control_spec, initial_state[:1])  # takes no step: it checks the data
        if nstep < 1 or not worlds:
            return
        if len(models) not in (1, worlds):
            raise ValueError(f"{worlds} rollouts have {len(models)} models")
        key, arrays = self._numbers.of(models)
        wide = mujoco.mj_stateSize(models[0], control_spec)
        rows = {"state0": (initial_state, mujoco.mj_stateSize(models[0], _STATE))}
        rows |= {"warmstart0": (initial_warmstart, models[0].nv), "control": (control, wide)}
        rows |= {"state": (state, rows["state0"][1]), "sensordata": (sensordata, models[0].nsensordata)}
        check_sizes(worlds, nstep, rows)
        given = _held(models[0], data, control_spec) if control is None else np.reshape(control, (worlds, nstep, wide))
        if lack := self._lacks(key, models[0], control_spec, given, arrays):
            self._fall(lack)
            self.diverged = None
            self._theirs.rollout(
                models, data, nstep, control_spec, initial_state, initial_warmstart, control, state, sensordata,
                chunk_size,
            )  # fmt: skip
            return
        given, mocap = np.broadcast_to(given, (worlds, nstep, wide)), control_spec != _CONTROL
        whole = _whole(models[0], control_spec, given) if mocap else given
        diverged = self._ready.of(key, models[0]).run(
            worlds, nstep, initial_state, initial_warmstart, whole, state, sensordata, arrays, mocap
        )
        if state is not None:
            _leave(models[-1], data[0], control_spec, initial_state, given, state, diverged=diverged[-1])
        self.diverged = diverged.copy()

    def _fall(self, lack: str) -> None:
        """Let MuJoCo roll out: the log says it once for each cause."""
        if not self._fall_back:
            raise ValueError(f"the physics of warpmpc has no {lack}")
        if lack not in self._told:
            self._told.add(lack)
            logger.warning("rollouts are MuJoCo's own: the physics of warpmpc has no %s", lack)

    def _lacks(
        self,
        key: bytes,
        model: mujoco.MjModel,
        control_spec: int,
        control: np.ndarray | None,
        arrays: dict[str, np.ndarray] | str,
    ) -> str | None:
        """Return the part that these rollouts lack."""
        if key not in self._lack:
            self._lack[key] = lacking(model)
        if self._lack[key]:
            return self._lack[key]
        if lack := callbacks():
            return lack
        if control_spec & ~(_CONTROL | _POSITION | _TURN):
            return "controls other than ctrl and mocap poses (control_spec)"
        if control is None:
            return "controls that are held and differ between the instances of MjData"
        return f"worlds that differ in {arrays}" if isinstance(arrays, str) else None


def _held(model: mujoco.MjModel, data: Sequence[mujoco.MjData], control_spec: int) -> np.ndarray | None:
    """Controls that instances of MjData hold ``[nu]``; None if they differ."""
    held = np.empty((len(data), mujoco.mj_stateSize(model, control_spec)))
    for row, one in zip(held, data, strict=True):
        mujoco.mj_getState(model, one, row, control_spec)
    return held[0] if (held == held[:1]).all() else None


def _leave(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    control_spec: int,
    initial_state: np.ndarray,
    control: np.ndarray,
    state: np.ndarray,
    *,
    diverged: bool,
) -> None:
    """Leave MjData as MuJoCo does: after the last step of the last rollout."""
    rows = np.reshape(state, (*control.shape[:2], -1))[-1]
    for inputs in (data.ctrl, data.qfrc_applied, data.xfrc_applied):
        inputs[...] = 0.0
    mocap = model.body_mocapid >= 0
    data.mocap_pos[model.body_mocapid[mocap]] = model.body_pos[mocap]
    data.mocap_quat[model.body_mocapid[mocap]] = model.body_quat[mocap]
    data.eq_active[...] = model.eq_active0
    mujoco.mj_setState(model, data, control[-1, -1], control_spec)
    mujoco.mj_setState(model, data, rows[-2] if len(rows) > 1 else initial_state[-1], _STATE)
    data.warning.number[...] = 0
    if diverged:
        data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number = 1
    else:
        mujoco.mj_step(model, data)
    mujoco.mj_setState(model, data, rows[-1], _STATE)


def _whole(model: mujoco.MjModel, control_spec: int, control: np.ndarray) -> np.ndarray:
    """Controls, positions and unit quaternions of mocap bodies; what is not given is zero, or as the model has it."""
    bodies = np.flatnonzero(model.body_mocapid >= 0)
    bodies = bodies[np.argsort(model.body_mocapid[bodies])]
    usual = {_CONTROL: np.zeros(model.nu), _POSITION: model.body_pos[bodies], _TURN: model.body_quat[bodies]}
    at, parts = 0, {}
    for bit, values in usual.items():
        width = values.size if control_spec & bit else 0
        parts[bit] = control[..., at : at + width] if width else values.ravel()
        at += width
    quats = parts[_TURN].reshape(*parts[_TURN].shape[:-1], -1, 4)
    parts[_TURN] = units(quats).reshape(parts[_TURN].shape)
    rows = control.shape[:-1]
    return np.concatenate([np.broadcast_to(x, (*rows, x.shape[-1])) for x in parts.values()], axis=-1)


class _Pool:
    """Rollouts of :func:`rollout`: each call has one to itself, and there are no more at once than cores."""

    def __init__(self) -> None:
        self._free = threading.Condition()
        self._most = len(os.sched_getaffinity(0))
        self._idle: dict[int, list[Rollout]] = {}
        self._busy, self._era = 0, 0

    @contextmanager
    def one(self, nthread: int) -> Iterator[Rollout]:
        """Hand out a rollout that is not in use."""
        with self._free:
            self._free.wait_for(lambda: self._busy < self._most)
            self._busy += 1
            era, idle = self._era, self._idle.setdefault(nthread, [])
            found = idle.pop() if idle else None
        try:
            found = found or Rollout(nthread=nthread)
            yield found
        finally:
            with self._free:
                self._busy -= 1
                kept = found is not None and era == self._era
                if kept:
                    idle.append(found)
                self._free.notify()
            if found is not None and not kept:
                found.close()

    def close(self) -> None:
        """End the threads of all that are idle, and later of those that are in use."""
        with self._free:
            idle, self._idle = [one for ones in self._idle.values() for one in ones], {}
            self._era += 1
        for one in idle:
            one.close()


_pool = _Pool()


def _after_fork() -> None:
    global _pool
    for native in list(_natives):
        native.forked()
    _pool = _Pool()


os.register_at_fork(after_in_child=_after_fork)


def shutdown_persistent_pool() -> None:
    """End the threads that calls of :func:`rollout` keep; those of a call in another thread when that returns."""
    _pool.close()


atexit.register(shutdown_persistent_pool)


def rollout(
    model: mujoco.MjModel | Sequence[mujoco.MjModel],
    data: mujoco.MjData | Sequence[mujoco.MjData],
    initial_state: np.ndarray,
    control: np.ndarray | None = None,
    *,
    persistent_pool: bool = False,
    **options: object,
) -> tuple[np.ndarray, np.ndarray]:
    """Roll out open-loop trajectories, as :func:`mujoco.rollout.rollout`; any number of threads may call it.

    Models and kernels stay ready between calls, whether the pool of threads is persistent or not.

    Args:
        model: The model, or one for each of W rollouts; these may differ in masses, inertias, friction and sizes.
        data: As many as there are threads, one for the calling thread alone. The first is left as after the last step
            of the last rollout.
        initial_state: ``[W, 1+nq+nv+na]`` or ``[1, ...]``: time, coordinates, velocities, activations.
        control: ``[W, T, nu]``, or 1 for W or T; what ``data`` holds if None.
        persistent_pool: Accepted as MuJoCo's.
        **options: Those of :meth:`mujoco.rollout.Rollout.rollout`.

    Returns:
        States ``[W, T, 1+nq+nv+na]`` after each control, and sensor readings ``[W, T, nsensordata]``.

    Raises:
        ValueError: If shapes or sizes are wrong.
    """
    datas = list(data) if isinstance(data, Sequence) else [data]
    with _pool.one(len(datas) if len(datas) > 1 else 0) as own:
        return own.rollout(model, datas, initial_state, control, **options)
