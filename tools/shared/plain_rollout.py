# SPDX-License-Identifier: Apache-2.0
"""Rollouts of a MuJoCo model without a scene: what tests and measurements compare with ``mujoco.rollout``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from warpmpc.kernels.engine.launch import TAPS
from warpmpc.physics.batch import shares
from warpmpc.physics.model import PhysicsModel
from warpmpc.physics.runtime.bake import native_lanes
from warpmpc.physics.runtime.launch import Launcher
from warpmpc.physics.source import RolloutSource
from warpmpc.physics.source_parts import WARP, RolloutWork, Steps, make_kernel
from warpmpc.physics.state_map import StateMap
from warpmpc.physics.unsupported import missing

if TYPE_CHECKING:
    from warpmpc.physics.source_parts import Parts


class PlainRollout:
    """Rolls controls of many worlds out in the engine's kernel.

    Args:
        model: The model.
        worlds: Number of worlds W.
        steps: Controls T of every world.
        substeps: Physics steps per control.
        arrays: Arrays of the model that differ between worlds, ``[W, ...]`` each.
        device: Warp device.
        lanes: Worlds in a vector on a CPU; as many as a register holds if None.
        share: Whether on a GPU a warp shares a world.

    Raises:
        ValueError: If the model has what the engine lacks.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        worlds: int,
        steps: int,
        *,
        substeps: int = 1,
        arrays: Mapping[str, np.ndarray] | None = None,
        device: str = "cpu",
        lanes: int | None = None,
        share: bool = True,
    ):
        lack = missing(model)
        if lack:
            raise ValueError(f"the engine fused has no {lack}")
        self.mj, self.worlds, self.device = model, worlds, device
        physics = self.physics = PhysicsModel(model, arrays)
        width = lanes or native_lanes()
        sharing = WARP if wp.get_device(device).is_cuda and share and shares(model, 0) else 1
        self._sharing = sharing
        on_gpu = wp.get_device(device).is_cuda
        parts = self._parts(width, shared=sharing > 1)
        self.kernel = make_kernel(parts.whole() if on_gpu else parts.rollouts(), width, sharing)
        self._lanes = 1 if on_gpu else width
        self._launch = Launcher(device)
        columns = physics.columns.values
        work = RolloutWork()
        if not on_gpu:
            self._steps = Steps(parts, "the physics of a model")
            work.steps = self._steps.address

        def zeros(*dims: int, dtype: type = float) -> wp.array:
            return wp.zeros(dims, dtype=dtype, device=device)

        work.initial = zeros(worlds, 1 + model.nq + model.nv + model.na, dtype=wp.float64)
        work.knots, work.domains, work.records = zeros(1, worlds, steps, model.nu), 1, 1
        tap = np.zeros((1, steps, int(TAPS)), dtype=np.int32)
        tap[0, :, 0] = np.arange(steps)  # a control is its own knot
        work.tap, work.share = wp.array(tap, device=device), wp.full(tap.shape, 1.0, dtype=float, device=device)
        work.lower, work.upper = (wp.full(model.nu, x, dtype=float, device=device) for x in (-np.inf, np.inf))
        work.substeps = wp.array([substeps] * steps, dtype=int, device=device)
        par = np.zeros((max(1, len(columns)), worlds), dtype=np.float32)
        for row, values in zip(par, columns, strict=False):
            row[:] = values
        work.given = wp.array(physics.given, dtype=float, device=device)
        work.par = wp.array(par, dtype=float, device=device)
        work.record_q, work.record_qd = zeros(steps + 1, worlds, model.nq), zeros(steps + 1, worlds, model.nv)
        work.record_act = zeros(steps + 1, worlds, model.na)
        work.diverged, work.overflow = zeros(worlds, dtype=int), zeros(worlds, dtype=int)
        self.work = work

    def source(self, *, lanes: int, shared: bool) -> str:
        """Source of a rollout.

        Args:
            lanes: Worlds in a vector on a CPU.
            shared: Whether on a GPU a warp shares a world.
        """
        return self._parts(lanes, shared=shared).whole()

    def _parts(self, lanes: int, *, shared: bool) -> Parts:
        plain = StateMap(plain=True, matrix=np.eye(self.mj.nu), offset=np.zeros(self.mj.nu))
        return RolloutSource(self.physics, plain, lanes, shared).parts()

    def __call__(
        self, q: np.ndarray, v: np.ndarray, control: np.ndarray, act: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates ``[T, W, nq]`` and velocities ``[T, W, nv]`` after every control.

        Args:
            q: Coordinates at the start ``[W, nq]``.
            v: Velocities at the start ``[W, nv]``.
            control: ``[T, W, nu]``.
            act: Activations at the start ``[W, na]``, zero if None.
        """
        work = self.work
        start = np.zeros((len(q), self.mj.na)) if act is None else act
        work.initial.assign(np.hstack([np.zeros((len(q), 1)), q, v, start]))
        if control.size:
            work.knots.assign(control.astype(np.float32).swapaxes(0, 1)[None])
        self.launch()
        return work.record_q.numpy()[1:], work.record_qd.numpy()[1:]

    def launch(self) -> None:
        """Roll out what was given last."""
        groups = -(-self.worlds // self._lanes)
        self._launch(self.kernel, groups * self._sharing, [0], [self.work], threads=WARP)
