# SPDX-License-Identifier: Apache-2.0
"""Many worlds of one MuJoCo model that controls are rolled out in, on the threads of a CPU or on a GPU."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from ..kernels.engine.launch import TAPS
from .base import MOST_SHARED
from .model import PhysicsModel
from .outputs import Outputs, field_width, write_outputs
from .runtime.bake import LARGEST, OutOfRange, native_lanes
from .runtime.compiling import compile_kernel
from .runtime.launch import CapturedLaunches, Launcher, capturing
from .runtime.thread_pool import PARTS, ThreadPool
from .source import RolloutSource
from .source_parts import WARP, RolloutWork, Steps, options, packed
from .unsupported import missing, tell_differences

if TYPE_CHECKING:
    from .source_parts import Parts

SHARED_PER_DOF = 180
"""Worlds for every degree of freedom up to which a warp shares a world on a GPU; with more there are threads enough for
one each. Five models from 7 to 27 degrees of freedom took equally long at 155 to 240."""


def shares(model: mujoco.MjModel, worlds: int) -> bool:
    """Tell if on a GPU a warp shares a world, rather than each thread having one."""
    if model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICIT) or model.nv > MOST_SHARED:
        return False  # a thread alone has the source of the one, memory for the other
    return worlds <= SHARED_PER_DOF * model.nv


@lru_cache(maxsize=64)
def _kernel(source: _Text, lanes: int, sharing: int) -> wp.Kernel:
    """The kernel of a source; one for sources that are alike."""
    threads = wp.constant(sharing)

    @wp.func_native(source.text)
    def rollout(o: Outputs, k: RolloutWork, group: int): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=options(lanes))
    def batch_kernel(
        # inputs
        first: int,  # group of thread 0
        # inputs and outputs
        k: RolloutWork,
        o: Outputs,
    ):
        """One thread: all steps of as many worlds as a number has lanes; on a GPU of one, or its part of one."""
        rollout(o, k, first + wp.tid() // threads)

    return batch_kernel


class _Text:
    """A source that is compared by its digest alone."""

    def __init__(self, text: str):
        self.text = text
        self.digest = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Text) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


class BatchRollout:
    """Rolls controls of many worlds out from a state each, and hands out states and sensor readings.

    Args:
        model: The model.
        worlds: Number of worlds W.
        steps: Controls T of every world.
        substeps: Physics steps per control, or of each.
        held: Whether all controls of a world are one that is held.
        arrays: Arrays of the model that differ between worlds, ``[W, ...]`` each; ``gravity`` may be among them.
        settable: Whether :meth:`set_arrays` takes any numbers, even where all worlds begin alike.
        fields: Fields of ``MjData`` (:mod:`.outputs`) that are handed out, in :attr:`sensordata` side by side.
        bodies: Bodies whose poses are handed out.
        pairs: Pairs of bodies whose contact forces are.
        mocap: Whether controls go on with the positions of all mocap bodies, then their quaternions.
        device: Warp device.
        threads: Threads on a CPU.
        sensors_before: Whether fields are those before each control, as in MuJoCo's step, rather than after it.
        in_place: Whether worlds go on from where they ended; T is 1 then.

    Raises:
        ValueError: If the model has what this physics lacks.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        worlds: int,
        steps: int,
        *,
        substeps: int | Sequence[int] = 1,
        held: bool = False,
        arrays: Mapping[str, np.ndarray] | None = None,
        settable: bool = False,
        fields: Sequence[str] = ("sensordata",),
        bodies: Sequence[int] = (),
        pairs: Sequence[tuple[int, int]] = (),
        mocap: bool = False,
        device: wp.DeviceLike = "cpu",
        threads: int = 1,
        sensors_before: bool = True,
        in_place: bool = False,
    ):
        if lack := missing(model):
            raise ValueError(f"the physics of warpmpc has no {lack}: change that in the model, or step it with mujoco")
        tell_differences(model)
        self.mj, self.worlds, self.steps, self.threads = model, worlds, steps, threads
        self._bodies, self._pairs, self._settable, self._mocap = tuple(bodies), tuple(pairs), settable, mocap
        self.fields, self._held = tuple(fields), held
        self.device = wp.get_device(device)
        with capturing:  # another thread's recording would take in what is allocated here
            self._build(arrays, substeps, sensors_before=sensors_before, in_place=in_place)

    def _build(
        self, arrays: Mapping[str, np.ndarray] | None, substeps: int, *, sensors_before: bool, in_place: bool
    ) -> None:
        model, worlds, threads = self.mj, self.worlds, self.threads
        on_gpu = self.device.is_cuda
        self._lanes = 1 if on_gpu else native_lanes()
        shared = on_gpu and shares(model, worlds) and "gravity" not in (arrays or {})  # links.h has it as a constant
        self._sharing = WARP if shared else 1
        self._decided: list[bool] | None = None
        parts, physics = self._write(arrays)
        physics.warn()
        self._text, self._launch = _Text(parts.whole()), Launcher(self.device)
        text = self._text if on_gpu else _Text(packed(parts.rollouts()))
        self._kernel = _kernel(text, native_lanes(), self._sharing)
        self.work, self.outputs = RolloutWork(), Outputs()
        what = "the physics of a model"
        if not on_gpu:
            self._model_steps = Steps(parts, what)
            self.work.steps = self._model_steps.address
        compile_kernel(self._kernel, self.device, WARP, what, source=text.text)
        self._fill(physics, substeps, sensors_before=sensors_before, in_place=in_place)
        groups = -(-worlds // self._lanes)
        parts = 1 if on_gpu else min(groups, threads * PARTS if threads > 1 else 1)
        edges = np.linspace(0, groups, parts + 1).astype(int).tolist()
        self._replays = [
            CapturedLaunches(lambda a=a, b=b: self._roll(a, b - a), device=self.device) for a, b in pairwise(edges)
        ]
        self._pool = ThreadPool(threads, parts) if parts > 1 else None

    def _write(self, arrays: Mapping[str, np.ndarray] | None) -> tuple[Parts, PhysicsModel]:
        """Parts of the source, and the model, whose columns are known then."""
        if self._settable and self.worlds == 1:  # one row would be that of all worlds
            arrays = {name: np.repeat(values, 2, axis=0) for name, values in (arrays or {}).items()}
        physics = PhysicsModel(self.mj, arrays, settable=self._settable, decided=self._decided)
        handed = {"fields": self.fields, "bodies": self._bodies, "pairs": self._pairs}
        state_map, code = write_outputs(physics, **handed, mocap=self._mocap)
        parts = RolloutSource(physics, state_map, native_lanes(), self._sharing > 1, code).parts()
        self._decided = physics.columns.decisions if self._settable else None
        return parts, physics

    def _fill(
        self, physics: PhysicsModel, substeps: int | Sequence[int], *, sensors_before: bool, in_place: bool
    ) -> None:
        m, work, out, worlds, steps = self.mj, self.work, self.outputs, self.worlds, self.steps

        def zeros(*dims: int, dtype: type = float) -> wp.array:
            return wp.zeros(dims, dtype=dtype, device=self.device)

        self.state = zeros(worlds, steps, 1 + m.nq + m.nv + m.na, dtype=wp.float64)
        width = sum(field_width(m, name) for name in self.fields)
        self.sensordata = zeros(worlds, steps, width, dtype=wp.float64)
        start = self.state.shape[0], self.state.shape[2]
        work.initial = self.state.reshape(start) if in_place else zeros(*start, dtype=wp.float64)
        columns = m.nu + (7 * m.nmocap if self._mocap else 0)
        work.knots, work.domains, work.records = zeros(1, worlds, 1 if self._held else steps, columns), 1, 0
        tap = np.zeros((1, steps, int(TAPS)), dtype=np.int32)
        tap[0, :, 0] = 0 if self._held else np.arange(steps)  # a control is its own knot
        work.tap = wp.array(tap, device=self.device)
        work.share = wp.full(tap.shape, 1.0, dtype=float, device=self.device)
        work.lower, work.upper = (wp.full(columns, x, dtype=float, device=self.device) for x in (-np.inf, np.inf))
        substeps = np.broadcast_to(substeps, steps).astype(np.int32)
        work.substeps = wp.array(substeps, dtype=int, device=self.device)
        work.diverged, work.overflow = zeros(worlds, dtype=int), zeros(worlds, dtype=int)
        work.given = wp.array(physics.given, dtype=float, device=self.device)
        work.par = zeros(max(1, len(physics.columns.values)), worlds)
        self._put_columns(physics)
        out.address, out.before, out.stay = zeros(2, dtype=wp.uint64), int(sensors_before), int(in_place)
        out.warmstart = zeros(worlds, m.nv)
        out.poses = zeros(worlds, len(self._bodies), 7)
        out.force = zeros(worlds, len(self._pairs), 3)
        self.hand_to(self.state, self.sensordata)

    def _put_columns(self, physics: PhysicsModel) -> None:
        if columns := physics.columns.values:
            values = np.stack([c[: self.worlds] for c in columns])
            if (np.abs(values) > LARGEST).any():
                raise OutOfRange(f"{np.abs(values).max():g} does not fit into single precision")
            self.work.par.assign(values.astype(np.float32))

    def set_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Give worlds other numbers, without compiling.

        Args:
            arrays: As at the start: the same arrays, ``[W, ...]`` each.

        Raises:
            ValueError: If other numbers differ between worlds than did at the start.
        """
        parts, physics = self._write(arrays)
        if _Text(parts.whole()) != self._text:
            raise ValueError("numbers that were zero or alike in all worlds at the start are not now: make a new one")
        with capturing:
            self.work.given.assign(physics.given.astype(np.float32))
            self._put_columns(physics)

    def hand_to(self, state: wp.array | np.ndarray, sensordata: wp.array | np.ndarray) -> None:
        """Let rollouts write into arrays of doubles, states ``[W, T, 1+nq+nv+na]``, readings ``[W, T, nsensordata]``.

        Args:
            state: Takes the states; must live as long as rollouts write into it.
            sensordata: Takes the sensor readings, likewise.
        """
        address = [x.ptr or 0 if isinstance(x, wp.array) else x.ctypes.data for x in (state, sensordata)]
        with capturing:
            self.outputs.address.assign(np.array(address, dtype=np.uint64))

    def run(self) -> None:
        """Roll out the knots of :attr:`work` from its initial states; on a GPU it may go on after this returns."""
        if self._pool is None:
            self._replays[0]()
        else:
            self._pool.run(self._replays)

    def _roll(self, first: int, groups: int) -> None:
        self._launch(self._kernel, groups * self._sharing, [first], [self.work, self.outputs], threads=WARP)
