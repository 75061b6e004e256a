# SPDX-License-Identifier: Apache-2.0
"""``mujoco.rollout`` with worlds in the lanes of a register: the same functions, arguments and arrays.

    from warpmpc.physics import rollout  # in place of: from mujoco import rollout

    state, sensordata = rollout.rollout(model, data, initial_state, control)

MuJoCo rolls out models that have more than this physics, with one line in the log. Rollouts are in single
precision; states and sensor readings are handed out as doubles.
"""

from __future__ import annotations

import atexit
import copy
import logging
import os
from collections import OrderedDict
from collections.abc import Sequence

import mujoco
import mujoco.rollout
import numpy as np
import warp as wp

from .batch import BatchRollout
from .callbacks import callbacks
from .missing import missing
from .model_numbers import ModelNumbers
from .sensors import unread_sensors

logger = logging.getLogger("warpmpc")
MODELS = 4
"""Models that are kept ready, and numbers of worlds and steps of each."""
_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)
_POSITION, _TURN = int(mujoco.mjtState.mjSTATE_MOCAP_POS), int(mujoco.mjtState.mjSTATE_MOCAP_QUAT)


def lacking(model: mujoco.MjModel) -> str | None:
    """Return what a model has and these rollouts lack, in a few words; None if there is nothing."""
    if lack := missing(model):
        return lack
    unread = [] if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_SENSOR) else unread_sensors(model)
    if unread:
        return f"sensors of the kinds {', '.join(unread)}"
    return None


class Rollout(mujoco.rollout.Rollout):
    """Rolls controls out, as :class:`mujoco.rollout.Rollout`.

    Args:
        nthread: Threads; 0 or None for the calling one alone. More than the cores of this process are not used.
        device: Warp device of the rollouts.
        fall_back: Whether MuJoCo rolls out what this physics lacks. If not, that is an error.
    """

    def __init__(self, *, nthread: int | None = None, device: wp.DeviceLike = "cpu", fall_back: bool = True):
        super().__init__(nthread=nthread)
        self.rollout_ = _Native(self.rollout_, self.nthread, device, fall_back=fall_back)


class _Native:
    """Receiver of the arrays that MuJoCo's class has checked.

    Args:
        mujoco_rollout: MuJoCo's own.
        nthread: Threads.
        device: Warp device.
        fall_back: Whether MuJoCo rolls out what this physics lacks.
    """

    def __init__(self, mujoco_rollout: object, nthread: int, device: wp.DeviceLike, *, fall_back: bool):
        self._mujoco, self._fall_back, self._device = mujoco_rollout, fall_back, device
        self._threads = max(1, min(nthread, len(os.sched_getaffinity(0))))
        self._numbers = ModelNumbers()
        self._ready: OrderedDict[bytes, _Ready] = OrderedDict()
        self._lack: dict[bytes, str | None] = {}
        self._told: set[str] = set()

    def rollout(
        self,
        model: mujoco.MjModel | Sequence[mujoco.MjModel],
        data: object,
        nstep: int,
        control_spec: int,
        initial_state: np.ndarray,
        initial_warmstart: np.ndarray | None = None,
        control: np.ndarray | None = None,
        state: np.ndarray | None = None,
        sensordata: np.ndarray | None = None,
        chunk_size: int | None = None,
    ) -> None:
        """Roll out; the arguments are those of MuJoCo's native function.

        Raises:
            ValueError: If this physics lacks what is asked for, and MuJoCo is not to step in.
        """
        models = [model] if isinstance(model, mujoco.MjModel) else list(model)
        key, arrays = self._numbers.of(models)
        lack = self._lacks(key, models[0], control_spec, control, arrays)
        if lack is None:
            mocap = control is not None and control_spec != _CONTROL
            control = _whole(models[0], control_spec, control) if mocap else control
            self._ready_for(key, models[0]).run(
                len(initial_state), nstep, initial_state, initial_warmstart, control, state, sensordata, arrays, mocap
            )
            return
        if not self._fall_back:
            raise ValueError(f"the physics of warpmpc has no {lack}")
        if lack not in self._told:
            logger.warning("rollouts are MuJoCo's own: the physics of warpmpc has no %s", lack)
        self._told.add(lack)
        self._mujoco.rollout(
            model, data, nstep, control_spec, initial_state, initial_warmstart, control, state, sensordata, chunk_size
        )

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
        if control is not None and control_spec & ~(_CONTROL | _POSITION | _TURN):
            return "controls other than ctrl and mocap poses (control_spec)"
        return f"worlds that differ in {arrays}" if isinstance(arrays, str) else None

    def _ready_for(self, key: bytes, model: mujoco.MjModel) -> _Ready:
        if key not in self._ready:
            self._ready[key] = _Ready(copy.copy(model), self._threads, self._device)
        self._ready.move_to_end(key)
        while len(self._ready) > MODELS:
            self._ready.popitem(last=False)
        return self._ready[key]


class _Ready:
    """Batches of a model, by their numbers of worlds and steps."""

    def __init__(self, model: mujoco.MjModel, threads: int, device: wp.DeviceLike):
        self._model, self._threads, self._device = model, threads, device
        self._batches: OrderedDict[tuple, tuple[BatchRollout, dict[str, np.ndarray]]] = OrderedDict()

    def run(
        self,
        worlds: int,
        steps: int,
        initial_state: np.ndarray,
        warmstart: np.ndarray | None,
        control: np.ndarray | None,
        state: np.ndarray | None,
        sensordata: np.ndarray | None,
        arrays: dict[str, np.ndarray],
        mocap: bool,
    ) -> None:
        """Roll out into arrays of the caller."""
        batch = self._batch(worlds, steps, arrays, mocap=mocap)
        work, out, on_cpu = batch.work, batch.outputs, batch.device.is_cpu
        put(work.initial, initial_state)
        put(work.knots, np.zeros(work.knots.shape[1:]) if control is None else control)
        put(out.warmstart, np.zeros(out.warmstart.shape) if warmstart is None else warmstart)
        direct = [_direct(x) and on_cpu for x in (state, sensordata)]
        own = batch.state, batch.sensordata
        given = state, sensordata
        batch.hand_to(*(x if d else y for x, y, d in zip(given, own, direct, strict=True)))
        batch.run()
        for x, y, d in zip(given, own, direct, strict=True):
            if x is not None and not d:
                x[...] = y.numpy()
        if lost := int(np.count_nonzero(work.overflow.numpy())):
            logger.warning("%d of %d worlds had more contacts at once than there is room for", lost, worlds)

    def _batch(self, worlds: int, steps: int, arrays: dict[str, np.ndarray], *, mocap: bool) -> BatchRollout:
        key = worlds, steps, tuple(sorted(arrays)), mocap
        if key not in self._batches:
            where = {"device": self._device, "threads": self._threads}
            made = BatchRollout(self._model, worlds, steps, arrays=arrays, mocap=mocap, **where)
            self._batches[key] = made, arrays
        batch, known = self._batches[key]
        if any(not np.array_equal(known[name], arrays[name]) for name in arrays):
            try:
                batch.set_arrays(arrays)
            except ValueError:  # other numbers are alike now: another source
                del self._batches[key]
                return self._batch(worlds, steps, arrays, mocap=mocap)
            self._batches[key] = batch, arrays
        self._batches.move_to_end(key)
        while len(self._batches) > MODELS:
            self._batches.popitem(last=False)
        return batch


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
    parts[_TURN] = (quats / np.linalg.norm(quats, axis=-1, keepdims=True)).reshape(parts[_TURN].shape)
    rows = control.shape[:-1]
    return np.concatenate([np.broadcast_to(x, (*rows, x.shape[-1])) for x in parts.values()], axis=-1)


def _direct(array: np.ndarray | None) -> bool:
    """Return whether rollouts can write into an array as it is."""
    return isinstance(array, np.ndarray) and array.dtype == np.float64 and array.flags.carray


def put(to: wp.array, values: np.ndarray) -> None:
    """Copy into an array of a device, rounding where that has single precision."""
    if to.device.is_cpu:
        to.numpy()[...] = np.reshape(values, to.shape)
    else:
        to.assign(np.ascontiguousarray(np.reshape(values, to.shape), dtype=wp.dtype_to_numpy(to.dtype)))


_persistent: Rollout | None = None


def shutdown_persistent_pool() -> None:
    """End the threads that ``rollout(..., persistent_pool=True)`` keeps."""
    global _persistent
    if _persistent is not None:
        _persistent.close()
    _persistent = None


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
    """Roll out open-loop trajectories, as :func:`mujoco.rollout.rollout`.

    Models and kernels stay ready between calls, whether the pool of threads is persistent or not.

    Args:
        model: The model, or one for each of W rollouts; these may differ in masses, inertias, friction and sizes.
        data: As many as there are threads, one for the calling thread alone.
        initial_state: ``[W, 1+nq+nv+na]`` or ``[1, ...]``: time, coordinates, velocities, activations.
        control: ``[W, T, nu]``, or 1 for W or T.
        persistent_pool: Accepted as MuJoCo's.
        **options: Those of :meth:`mujoco.rollout.Rollout.rollout`.

    Returns:
        States ``[W, T, 1+nq+nv+na]`` after each control, and sensor readings ``[W, T, nsensordata]``.

    Raises:
        ValueError: If shapes or sizes are wrong.
    """
    global _persistent
    datas = list(data) if isinstance(data, Sequence) else [data]
    nthread = len(datas) if len(datas) > 1 else 0
    if _persistent is None or _persistent.nthread != nthread:
        shutdown_persistent_pool()
        _persistent = Rollout(nthread=nthread)
    return _persistent.rollout(model, datas, initial_state, control, **options)
