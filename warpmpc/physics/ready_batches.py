# SPDX-License-Identifier: Apache-2.0
"""Batches of a model that stay ready for rollouts of other numbers of worlds and steps.

Rows of MuJoCo's whole state, ``[W, nstate]``, which rollouts start from and end in.
"""

from __future__ import annotations

import copy
import logging
from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence

import mujoco
import mujoco.batch
import numpy as np
import warp as wp

from .batch import BatchRollout
from .version import MORE_STATE

logger = logging.getLogger("warpmpc")
MODELS = 4
"""Models that are kept ready, and numbers of worlds and steps of each."""


class Ready:
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
        control: np.ndarray,
        state: np.ndarray | None,
        sensordata: np.ndarray | None,
        arrays: dict[str, np.ndarray],
        mocap: bool,
    ) -> np.ndarray:
        """Roll out into arrays of the caller; returns which worlds diverged ``[W]``."""
        batch = self.batch(worlds, steps, arrays, mocap=mocap)
        work, out, on_cpu = batch.work, batch.outputs, batch.device.is_cpu
        put(work.initial, initial_state)
        put(work.knots, control)
        put(out.warmstart, np.zeros(out.warmstart.shape) if warmstart is None else warmstart)
        direct = [_direct(x) and on_cpu for x in (state, sensordata)]
        own = batch.state, batch.sensordata
        given = state, sensordata
        batch.hand_to(*(x if d else y for x, y, d in zip(given, own, direct, strict=True)))
        batch.run()
        for x, y, d in zip(given, own, direct, strict=True):
            if x is not None and not d:
                x[...] = y.numpy().reshape(x.shape)
        if lost := int(np.count_nonzero(work.overflow.numpy())):
            logger.warning("%d of %d worlds had more contacts at once than there is room for", lost, worlds)
        diverged = work.diverged.numpy() != 0
        if diverged.any():
            logger.warning("%d of %d worlds diverged and stay where they were", diverged.sum(), worlds)
        return diverged

    def batch(self, worlds: int, steps: int, arrays: Mapping[str, np.ndarray], **options: Hashable) -> BatchRollout:
        """A batch in which worlds have these numbers.

        Args:
            worlds: Number of worlds W.
            steps: Number of controls.
            arrays: Arrays that differ between worlds ``[W, ...]``, which must not change.
            **options: Others of :class:`BatchRollout`.
        """
        key = worlds, steps, tuple(sorted(arrays)), *sorted(options.items())
        if key not in self._batches:
            where = {"device": self._device, "threads": self._threads}
            made = BatchRollout(self._model, worlds, steps, arrays=arrays, **options, **where)
            self._batches[key] = made, arrays
        batch, known = self._batches[key]
        if any(known[name] is not own and not np.array_equal(known[name], own) for name, own in arrays.items()):
            try:
                batch.set_arrays(arrays)
            except ValueError:  # other numbers are alike now: another source
                del self._batches[key]
                return self.batch(worlds, steps, arrays, **options)
            self._batches[key] = batch, arrays
        self._batches.move_to_end(key)
        while len(self._batches) > MODELS:
            self._batches.popitem(last=False)
        return batch


class ReadyModels:
    """The models that were used last, each with its batches."""

    def __init__(self, threads: int, device: wp.DeviceLike):
        self._where = threads, device
        self._ready: OrderedDict[bytes, Ready] = OrderedDict()

    def of(self, key: bytes, model: mujoco.MjModel) -> Ready:
        """Batches of a model that :class:`ModelNumbers` has given a key."""
        if key not in self._ready:
            self._ready[key] = Ready(copy.copy(model), *self._where)
        self._ready.move_to_end(key)
        while len(self._ready) > MODELS:
            self._ready.popitem(last=False)
        return self._ready[key]

    def clear(self) -> None:
        """Let go of all."""
        self._ready.clear()


def check_sizes(worlds: int, steps: int, widths: Mapping[str, tuple[np.ndarray | None, int]]) -> None:
    """Refuse arrays that do not have the sizes ``worlds · steps · width``, in the words of MuJoCo.

    Raises:
        ValueError: If one has another size.
    """
    for name, (array, width) in widths.items():
        size = worlds * (1 if name.endswith("0") else steps) * width
        if array is not None and np.size(array) != size:
            raise ValueError(f"{name}.size should be {size}, got {np.size(array)}")


def _direct(array: np.ndarray | None) -> bool:
    """Return whether rollouts can write into an array as it is."""
    return isinstance(array, np.ndarray) and array.dtype == np.float64 and array.flags.carray


def put(to: wp.array, values: np.ndarray) -> None:
    """Copy into an array of a device, rounding where that has single precision."""
    with np.errstate(over="ignore"):  # what single precision does not hold diverges
        if to.device.is_cpu:
            to.numpy()[...] = np.reshape(values, to.shape)
        else:
            to.assign(np.ascontiguousarray(np.reshape(values, to.shape), dtype=wp.dtype_to_numpy(to.dtype)))


def units(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions ``[..., 4]`` of length 1; those of length 0 are the identity, as MuJoCo has them."""
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    none = length < mujoco.mjMINVAL
    return np.where(none, (1.0, 0.0, 0.0, 0.0), quaternions / np.where(none, 1.0, length))


_BITS = {
    name: int(getattr(mujoco.mjtState, f"mjSTATE_{name}"))
    for name in ("TIME", "QPOS", "QVEL", "ACT", "HISTORY", "WARMSTART", "CTRL", "QFRC_APPLIED", "XFRC_APPLIED",
                 "EQ_ACTIVE", "MOCAP_POS", "MOCAP_QUAT", "USERDATA", "PLUGIN", *MORE_STATE)
}  # fmt: skip
"""Components of a state, in their order."""
_STEPPED = ("TIME", "QPOS", "QVEL", "ACT")
_GIVEN = ("CTRL", "MOCAP_POS", "MOCAP_QUAT")
FIELDS = {name.lower(): name for name in _BITS if name not in ("WARMSTART", "PLUGIN")}
"""Fields of ``MjData`` that are components of a state which rollouts can record."""
Record = tuple[str | None, int, np.ndarray]
"""A field, or the bits of a state, and where it is recorded ``[n, T, ...]``."""


class StateRows:
    """The states of all simulations.

    Args:
        model: The model.
        mujoco_batch: Holder of the rows.
    """

    def __init__(self, model: mujoco.MjModel, mujoco_batch: object):
        self._model, self.all = model, mujoco_batch.state()
        components = {name: mujoco_batch.state_component(bit) for name, bit in _BITS.items()}
        self._at = {name: slice(first, first + size) for name, (first, size) in components.items()}
        self._driving = _GIVEN if model.nmocap else _GIVEN[:1]
        self._width = 1 + model.nq + model.nv + model.na

    def part(self, name: str) -> np.ndarray:
        """A component of all simulations ``[W, ...]``, a view."""
        return self.all[:, self._at[name]]

    def lacking(self) -> str | None:
        """Return what is in the rows and steps do not read, in a few words."""
        for name in ("QFRC_APPLIED", "XFRC_APPLIED"):
            if self.part(name).any():
                return f"applied forces ({name.lower()})"
        if (self.part("EQ_ACTIVE") != self._model.eq_active0).any():
            return "equalities that are switched (eq_active)"
        return None

    def refused(self, control: np.ndarray | None, spec: int, records: Sequence[Record]) -> str | None:
        """Return what is asked of a rollout and cannot be had, in a few words."""
        if any(name is None and bits & _BITS["WARMSTART"] for name, bits, _ in records):
            return "records of qacc_warmstart"
        if control is not None and spec & ~sum(_BITS[name] for name in _GIVEN):
            return "controls other than ctrl and mocap poses (control_spec)"
        return None

    def fit(self, count: int, steps: int, control: np.ndarray | None, spec: int, records: Sequence[Record]) -> bool:
        """Return whether arrays have the shapes and types that MuJoCo asks for, as far as states are concerned."""
        asked = [] if control is None else [(control, self._size(spec))]
        asked += [(to, self._size(self.bits(name, bits))) for name, bits, to in records if name in FIELDS or not name]
        return all(name is None or name in mujoco.batch.DATA_FIELDS for name, _, _ in records) and all(
            isinstance(to, np.ndarray)
            and to.dtype in (np.float64, np.uint8, np.bool_)
            and to.flags.c_contiguous
            and (to.flags.writeable or to is control)
            and to.shape[:2] == (count, steps)
            and to.size == count * steps * size
            for to, size in asked
        )

    def _size(self, bits: int) -> int:
        return mujoco.mj_stateSize(self._model, bits) if 0 <= bits < 1 << len(_BITS) else -1

    def controls(self, chosen: np.ndarray, control: np.ndarray | None, spec: int) -> dict[str, np.ndarray]:
        """What drives all simulations, ``[W, T, ...]`` each; T is 1 where nothing is given and all is held.

        Args:
            chosen: Mask of the simulations that controls are given for.
            control: Given ones ``[n, T, ...]``, or None; the rest is as in the rows.
            spec: Components of the state that are given.
        """
        steps, first, out = 1 if control is None else control.shape[1], 0, {}
        for name in self._driving:
            out[name] = np.repeat(self.part(name)[:, None], steps, axis=1)
            if control is not None and spec & _BITS[name]:
                out[name][chosen] = control[..., first : first + out[name].shape[2]]
                first += out[name].shape[2]
        return out

    def load(self, batch: BatchRollout, controls: dict[str, np.ndarray]) -> None:
        """Let rollouts start from the rows and follow controls."""
        put(batch.work.initial, self.all[:, : self._width])
        put(batch.outputs.warmstart, self.part("WARMSTART"))
        parts = dict(controls)
        if (quats := parts.pop("MOCAP_QUAT", None)) is not None:
            parts["MOCAP_QUAT"] = units(quats.reshape(*quats.shape[:2], -1, 4)).reshape(quats.shape)
        put(batch.work.knots, np.concatenate(list(parts.values()), axis=-1))

    def store(
        self, batch: BatchRollout, states: np.ndarray, controls: dict[str, np.ndarray], kept: slice | np.ndarray
    ) -> None:
        """Move the rows of some simulations to where rollouts ended."""
        self.all[kept, : self._width] = states[kept, -1]
        self.part("WARMSTART")[kept] = batch.outputs.warmstart.numpy()[kept]
        for name, values in controls.items():
            self.part(name)[kept] = values[kept, -1]

    def record(self, bits: int, states: np.ndarray, controls: dict[str, np.ndarray]) -> np.ndarray:
        """Components of a state after each step ``[W, T, ...]``."""
        shape, parts = states.shape[:2], []
        for name in (name for name, bit in _BITS.items() if bits & bit):
            values = states[..., self._at[name]] if name in _STEPPED else controls.get(name, self.part(name)[:, None])
            parts.append(np.broadcast_to(values, (*shape, values.shape[2])))
        return np.concatenate(parts, axis=-1)

    @staticmethod
    def bits(name: str | None, bits: int) -> int:
        """Bits of the state that a record asks for; 0 where it asks for a field that is not of a state."""
        return bits if name is None else _BITS.get(FIELDS.get(name), 0)
