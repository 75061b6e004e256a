# SPDX-License-Identifier: Apache-2.0
"""Batches of a model that stay ready for rollouts of other numbers of worlds and steps."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Hashable, Mapping

import mujoco
import numpy as np
import warp as wp

from .batch import BatchRollout

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
            arrays: Arrays that differ between worlds ``[W, ...]``, which nobody changes.
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
