# SPDX-License-Identifier: Apache-2.0
"""``mujoco.batch`` with simulations in the lanes of a register: the same class, arguments and arrays.

    from warpmpc.physics import Batch  # in place of: from mujoco.batch import Batch

    batch = Batch(model, nsim=1024, nthread=8)
    qpos, ctrl, xpos = batch.bind("qpos"), batch.bind("ctrl"), batch.bind("xpos")
    ctrl[:] = policy(qpos)
    batch.step()

Steps are in single precision; rows of the state and bound fields are doubles, as MuJoCo's.
"""

from __future__ import annotations

import copy
import logging
import operator
import os
import threading
from collections.abc import Callable, Iterable
from functools import wraps
from itertools import pairwise

import mujoco
import mujoco.batch
import numpy as np
import warp as wp

from .batch import BatchRollout
from .model_numbers import VARYING, says_something
from .outputs import field_width, unwritten_field
from .ready_batches import FIELDS, Ready, Record, StateRows, put
from .runtime.bake import LARGEST
from .unsupported import callbacks, missing

logger = logging.getLogger("warpmpc")
OWN = (*VARYING, "actuator_gainprm", "actuator_biasprm", "opt.gravity")
"""Fields of a model that may differ between simulations."""


class Batch(mujoco.batch.Batch):
    """Simulations of a model, as :class:`mujoco.batch.Batch`.

    MuJoCo itself takes the steps for which this physics lacks something, with a line in the log that names it. Where
    that is an output alone, it takes the last substep of a call. It also takes the steps of simulations that diverge.

    Args:
        model: The model.
        nsim: Number of simulations.
        nthread: Threads; 0 for one for each core.
        persistent: As MuJoCo's; it takes all steps then.
        device: Warp device of the steps.
        fall_back: Whether MuJoCo takes steps. If not, what this physics lacks is an error.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        nsim: int,
        nthread: int = 0,
        persistent: bool = False,
        *,
        device: wp.DeviceLike = "cpu",
        fall_back: bool = True,
    ):
        super().__init__(model, nsim, nthread, persistent)
        object.__setattr__(self, "_b", _Native(self._b, copy.copy(model), device, fall_back=fall_back))


def _one_at_a_time(call: Callable[..., int]) -> Callable[..., int]:
    """Calls of several threads wait for each other."""

    @wraps(call)
    def locked(self: _Native, *arguments: object) -> int:
        with self._lock:
            return call(self, *arguments)

    return locked


class _Native:
    """Receiver of the arrays that MuJoCo's class has checked.

    Args:
        mujoco_batch: MuJoCo's own.
        model: The model; it must not change.
        device: Warp device.
        fall_back: Whether MuJoCo takes the steps that this physics lacks something for.
    """

    def __init__(self, mujoco_batch: object, model: mujoco.MjModel, device: wp.DeviceLike, *, fall_back: bool):
        self._mujoco, self._model, self._fall_back = mujoco_batch, model, fall_back
        self._lock, self._status = threading.Lock(), mujoco_batch.status()
        self._rows = StateRows(model, mujoco_batch)
        self._outputs: dict[str, np.ndarray] = {}
        self._written: dict[str, str | None] = {}
        self._expanded: dict[str, np.ndarray] = {}
        self._arrays: dict[str, np.ndarray] = {}
        self._own_models = False
        self._told: set[str] = set()
        self._ready = Ready(model, max(1, min(mujoco_batch.nthread, len(os.sched_getaffinity(0)))), device)
        self._lack = missing(model)
        if mujoco_batch.persistent:
            self._lack = "data that persist between calls"

    def __getattr__(self, name: str) -> object:
        return getattr(self._mujoco, name)

    def output(self, name: str) -> np.ndarray | None:
        """Memory of a field that every call writes; the name is remembered."""
        memory = self._mujoco.output(name)
        if memory is not None:
            self._outputs[name] = memory
        return memory

    def expand(self, name: str) -> np.ndarray | None:
        """Memory of a field of the model with values of each simulation; the name is remembered."""
        memory = self._mujoco.expand(name)
        if memory is not None:
            self._expanded[name] = memory
        return memory

    def set_const(self, ids: np.ndarray | None = None) -> int:
        """Derive fields of the model from others, for each simulation."""
        failed = self._mujoco.set_const(ids)
        for name in OWN:
            memory = self._mujoco.expanded(name)
            if memory is not None:
                self._expanded[name] = memory
        return failed

    def set_models(self, models: object) -> None:
        """Let simulations run on models of the caller."""
        self._mujoco.set_models(models)
        self._own_models = models is not None

    @_one_at_a_time
    def step(self, ids: np.ndarray | None = None, nstep: int = 1, stage: int = 0) -> int:
        """Advance simulations; returns how many failed."""
        if not 1 <= operator.index(nstep) < 2**31:
            return self._mujoco.step(ids, nstep, stage)  # it complains
        own, why = nstep, self._lacks()
        if why:
            own = 0
        elif why := self._unwritten(self._outputs) or ("stages after a step" if stage else None):
            own -= 1
        if why:
            self._say(why, "the last substep of a call" if own > 0 else "steps")
        if own < 1:
            return self._mujoco.step(ids, nstep, stage)
        chosen, before = self._chosen(ids), self._rows.all.copy() if own < nstep else None
        # outputs are those before the last substep, which is a separate control
        batch = self._batch(min(own, 2), self._outputs if own == nstep else (), held=True)
        put(batch.work.substeps, np.array([own - 1, 1] if own > 1 else [1]))
        bad = self._advance(batch, chosen, self._rows.controls(chosen, None, 0))
        failed = self._mujoco.step(_ids(bad), own, 0) if bad.any() else 0
        if own == nstep:
            return failed
        failed += self._mujoco.step(ids, nstep - own, stage)
        lost = chosen & (self._status != 0)
        self._rows.all[lost] = before[lost]
        return failed

    @_one_at_a_time
    def rollout(
        self, ids: np.ndarray | None, nstep: int, control: np.ndarray | None, control_spec: int, records: list[Record]
    ) -> int:
        """Advance simulations and record after each substep; returns how many failed."""
        rows, chosen = self._rows, self._chosen(ids)
        fields = {*self._outputs, *(name for name, _, _ in records if name is not None and name not in FIELDS)}
        if not rows.fit(int(chosen.sum()), nstep, control, control_spec, records):
            failed = self._mujoco.rollout(ids, nstep, control, control_spec, records)  # it complains, too
            self._say("records and controls of these shapes", "rollouts")
            return failed
        why = self._lacks() or self._unwritten(fields) or rows.refused(control, control_spec, records)
        if why:
            self._say(why, "rollouts")
        if nstep < 1 or why:
            return self._mujoco.rollout(ids, nstep, control, control_spec, records)
        batch, controls = self._batch(nstep, fields, held=control is None), rows.controls(chosen, control, control_spec)
        bad = self._advance(batch, chosen, controls)
        states, values = batch.state.numpy(), self._fields(batch)
        for name, bits, to in records:
            whole = values[name] if name in values else rows.record(rows.bits(name, bits), states, controls)
            to[...] = whole[chosen].reshape(to.shape)
        if not bad.any():
            return 0
        again = bad[chosen]
        parts = [(name, bits, np.ascontiguousarray(to[again])) for name, bits, to in records]
        control = None if control is None else np.ascontiguousarray(control[again])
        failed = self._mujoco.rollout(_ids(bad), nstep, control, control_spec, parts)
        for (_, _, to), (_, _, part) in zip(records, parts, strict=True):
            to[again] = part
        return failed

    def _advance(self, batch: BatchRollout, chosen: np.ndarray, controls: dict[str, np.ndarray]) -> np.ndarray:
        """Roll chosen simulations out and move their rows; returns the mask of those whose steps are MuJoCo's."""
        self._rows.load(batch, controls)
        batch.run()
        lost = ~(np.abs(controls["CTRL"]) < mujoco.mjMAXVAL).all(axis=(1, 2))
        lost |= (batch.work.diverged.numpy() | batch.work.overflow.numpy()) != 0
        kept = chosen & ~lost
        if (bad := chosen & lost).any():
            logger.info("%d of %d simulations are stepped by MuJoCo: they diverge", bad.sum(), len(bad))
        self._status[chosen] = 0
        where = slice(None) if kept.all() else kept
        self._rows.store(batch, batch.state.numpy(), controls, where)
        for name, values in self._fields(batch).items():
            if name in self._outputs:
                self._outputs[name].view(np.float64)[where] = values[where, -1]
        return bad

    def _fields(self, batch: BatchRollout) -> dict[str, np.ndarray]:
        """Fields that rollouts handed out, ``[W, T, ...]`` each."""
        edges = np.cumsum([0, *(field_width(self._model, name) for name in batch.fields)]).tolist()
        values = batch.sensordata.numpy()
        return {name: values[..., a:b] for name, (a, b) in zip(batch.fields, pairwise(edges), strict=True)}

    def _chosen(self, ids: np.ndarray | None) -> np.ndarray:
        """Mask of simulations."""
        chosen = np.full(self._mujoco.nsim, ids is None)
        if ids is not None:
            chosen[ids] = True
        return chosen

    def _lacks(self) -> str | None:
        """Return what this physics lacks for a call, in a few words."""
        if self._own_models:
            return "models of the caller (set_models)"
        return self._lack or callbacks() or self._rows.lacking() or self._differing()

    def _unwritten(self, names: Iterable[str]) -> str | None:
        """Return what this physics lacks to write fields of MuJoCo's data."""
        for name in names:
            if name not in self._written:
                self._written[name] = unwritten_field(self._model, name)
        return next((self._written[name] for name in sorted(names) if self._written[name]), None)

    def _say(self, why: str, what: str) -> None:
        """Log once what MuJoCo does, or raise an error."""
        if not self._fall_back:
            raise ValueError(f"the physics of warpmpc has no {why}")
        if (why, what) not in self._told:
            logger.warning("%s of a batch are MuJoCo's own: the physics of warpmpc has no %s", what, why)
        self._told.add((why, what))

    def _differing(self) -> str | None:
        """Take over the fields that differ between simulations; return those that may not."""
        for name, memory in self._expanded.items():
            if not says_something(name) and name not in OWN:
                continue
            option = name.removeprefix("opt.")
            nominal = np.asarray(getattr(self._model.opt if option != name else self._model, option))
            kind = (np.float64 if nominal.dtype.kind == "f" else np.int32) if option != name else nominal.dtype
            values = memory.view(kind)
            known = self._arrays.get(option, nominal[None]).reshape(-1, nominal.size)[:, : values.shape[1]]
            if (values == known).all():
                continue
            if name not in OWN:
                return f"worlds that differ in {name}"
            if not (np.abs(values) <= LARGEST).all():
                return f"numbers of {name} beyond single precision"
            self._arrays[option] = values.reshape(len(values), *nominal.shape).copy()
        return None

    def _batch(self, steps: int, fields: Iterable[str], *, held: bool) -> BatchRollout:
        """Rollouts that hand fields out, in which simulations have their own numbers."""
        m, arrays = self._model, dict(self._arrays)
        handed = {"fields": tuple(sorted(fields)), "bodies": range(m.nbody), "held": held, "mocap": m.nmocap > 0}
        return self._ready.batch(self._mujoco.nsim, steps, arrays, settable=bool(arrays), **handed)


def _ids(chosen: np.ndarray) -> np.ndarray:
    return np.flatnonzero(chosen).astype(np.int32)
