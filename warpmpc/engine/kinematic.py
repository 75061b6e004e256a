# SPDX-License-Identifier: Apache-2.0
"""The engine ``kinematic``: no physics; joints follow the controls, and rollouts are judged on the way (STORM).

Thousands of samples take less than a millisecond: one launch takes them from knots to costs, with the robot and most
terms written out as straight-line source (``warpmpc.bake``). Terms without such a form are called in the same launch on
what it records. What is not driven stands still where it is observed.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..bake.lines import Lines
from ..bake.motion import WARP
from ..bake.number import native_lanes
from ..bake.rollout import RolloutSource, TermSource
from ..bake.state import StateCode, TermCode, moving_dofs
from ..compiling import compile_kernel
from ..cost.kernel import judge_code
from ..cost.stack import Judge
from ..cost.term import CostTerm
from ..kernels.planning.splines import ZERO
from ..kernels.worlds.kinematic import (
    ACCELERATION,
    POSITION,
    TAPS,
    VELOCITY,
    Drives,
    KinematicWork,
    explain_total_kernel,
    finish_kernel,
    kinematic_rollout_kernel,
    taps_kernel,
)
from ..launch import Launcher, Replay, capturing
from ..model.batch_size import BatchSize
from ..model.joints import joint_table
from ..model.trajectory import Trajectory
from ..scene.errors import SceneError
from .crew import Crew
from .kinematic_kernel import make_kernel

if TYPE_CHECKING:
    from ..model.layout import Layout
    from .protocol import Proposal
    from .registry import EngineRequest

MODES = {"velocity": int(VELOCITY), "position": int(POSITION), "acceleration": int(ACCELERATION)}
PARTS = 4
"""Parts of the samples per thread, as in the engine ``mujoco``."""


class KinematicEngine:
    """Rolls knots out by kinematics alone and judges them in the same launch.

    Args:
        request: What the engine is built for.

    Raises:
        SceneError: If the scene asks for what has no meaning without physics.
    """

    name = "kinematic"

    cost: wp.array2d[float]
    """Cost of every sample, +inf where it is not finite, ``[E, S]``."""
    term_cost: wp.array2d[float]
    """What each term added to the cost of the sample asked for last, ``[E, term]``."""
    diverged: wp.array[int]
    """Nonzero where a cost is not finite, ``[W]``."""
    overflow: wp.array[int]
    """Zeros, ``[W]``: there is nothing to overflow."""

    def __init__(self, request: EngineRequest):
        _refuse(request)
        self.request, self.device = request, request.device
        self.costs, self.shape, self.state = request.costs, request.shape, request.state
        self.layout = request.costs.layout
        self._launch, self._on_gpu = Launcher(self.device), wp.get_device(self.device).is_cuda
        self._replays: dict[int, tuple[Proposal, Replay, list[Replay]]] = {}
        self.lanes = native_lanes()
        self._allocate()
        source, staged = self._source()
        self.records = bool(staged)
        """Whether rollouts are recorded, because there are terms without baked source."""
        self._bind(staged)
        kernels = [(i, *self.costs.terms[i]) for i in staged if isinstance(self.costs.terms[i][0], CostTerm)]
        judge = None
        if kernels:
            code = judge_code([(i, term) for i, term, _ in kernels])
            self._own = code.params()
            for i, _, bound in kernels:
                setattr(self._own, f"p{i}", bound)
            judge = code
        self._judges = judge is not None
        self._kernel = make_kernel(source, self.costs.code.params, self.lanes, judge)
        compile_kernel(self._kernel, self.device, 256, f"the rollouts of {request.scene.name}")
        self.parts, groups = self._split()
        self._groups = 0 if self._on_gpu else groups
        self._crew = Crew(self.threads, len(self.parts))

    @property
    def threads(self) -> int:
        """CPU threads that share the samples."""
        return 1 if self._on_gpu else self.request.scene.engine.threads or len(os.sched_getaffinity(0))

    def _allocate(self) -> None:
        request, shape = self.request, self.shape
        terms, steps, envs = len(self.costs.terms), shape.horizon, shape.envs

        def zeros(*dims: int, dtype: type = float) -> wp.array:
            return wp.zeros(dims, dtype=dtype, device=self.device)

        self.cost, self.term_cost = zeros(envs, shape.samples), zeros(envs, terms)
        self.diverged, self.overflow = zeros(shape.worlds, dtype=int), zeros(shape.worlds, dtype=int)
        grid, spline = request.grid, request.spline
        self.grid = grid.arrays(self.device)
        place = (grid.t[:-1] / grid.dt[0]).astype("float32") * (grid.dt[:1].astype("float32") / spline.knot_dt)
        self._step_place = wp.array(place, dtype=float, device=self.device)
        knots = len(spline.time)
        self._unit = wp.array(np.eye(knots)[:, :, None], dtype=float, device=self.device)
        work = KinematicWork()
        work.tap, work.share = zeros(envs, steps, int(TAPS), dtype=int), zeros(envs, steps, int(TAPS))
        work.lower, work.upper = request.limits
        state = self.state
        work.joint_q, work.joint_qd, work.mocap, work.weight = state.joint_q, state.joint_qd, state.mocap, state.weight
        work.dt, work.step_weight, work.total = self.grid.dt, self.grid.weight, zeros(terms, shape.worlds)
        self._work = work
        # only knots that stand still between plans change their part in a step's control
        self._steps_of_plan = spline.kind == int(ZERO) and spline.even != 0
        self._taps(zeros(envs))

    def _source(self) -> tuple[str, list[int]]:
        """Source of the kernel, and the terms that it does not hold."""
        writer = StateCode(self.layout, moving_dofs(self.layout), quaternions=True)
        baked, staged = [], []
        for i, (term, bound) in enumerate(self.costs.terms):
            code = TermCode(writer, Lines(f"t{i}_"), f"p.p{i}")
            native = term.native if isinstance(term, CostTerm) else None
            value = native(code, bound) if native else None
            if value is None:
                staged.append(i)
            else:
                baked.append(TermSource(i, code.lines, value))
        spline = self.request.spline
        source = RolloutSource(writer, tuple(baked), spline.kind, len(spline.time), self.lanes, bool(staged))
        return source.write(), staged

    def _bind(self, staged: list[int]) -> None:
        """The record that terms without baked source read, as long as there are any, and what all terms see."""
        shape, layout, work = self.shape, self.layout, self._work
        recorded = shape if staged else BatchSize(1, 1, 1, shape.horizon)
        self.recorded = out = Trajectory.allocate(recorded, layout, 0, self.device)
        work.record_q, work.record_qd = out.joint_q, out.joint_qd
        work.record_body_q, work.record_body_qd = out.body_q, out.body_qd
        work.control = out.control
        self.judge = Judge(self.costs, out, out.control, self.state, recorded, self.request.grid.t)
        self._staged = wp.array(staged, dtype=int, device=self.device)

    def _split(self) -> tuple[list[tuple[int, int, int, int]], int]:
        """First group, groups, first sample and samples of each part; and the groups of an environment."""
        shape = self.shape
        if self._on_gpu:
            return [(0, shape.worlds * WARP, 0, shape.worlds)], 0
        groups = -(-shape.samples // self.lanes)
        count = groups * shape.envs
        size = count if self.threads == 1 else max(1, -(-count // (PARTS * self.threads)))

        def sample(group: int) -> int:
            return group // groups * shape.samples + group % groups * self.lanes

        parts = []
        for first in range(0, count, size):
            end = min(first + size, count)
            parts.append((first, end - first, sample(first), sample(end) - sample(first)))
        return parts, groups

    def evaluate(self, proposal: Proposal) -> None:
        """Roll proposed knots out from the observed state and judge them, into :attr:`cost`.

        Capture-safe on CUDA. On the CPU every part of the samples is a sequence of its own.
        """
        if self._on_gpu:
            if self._steps_of_plan:
                self._taps(proposal.offset)
            self._take(proposal, self.parts[0])
        else:
            if id(proposal) not in self._replays:
                parts = [Replay(partial(self._take, proposal, part)) for part in self.parts]
                self._replays[id(proposal)] = proposal, Replay(partial(self._taps, proposal.offset)), parts
            _, taps, parts = self._replays[id(proposal)]
            if self._steps_of_plan:
                taps()
            self._crew.run(parts)
        if not self.costs.capturable:
            self.judge.launch_arrays()
            self._finish(0, self.shape.worlds)

    def _taps(self, offset: wp.array) -> None:
        """Which knots the controls depend on at present."""
        inputs = [self._unit, self.request.spline, self.grid.t, self._step_place, offset]
        self._launch(taps_kernel, self._work.tap.shape[:2], inputs, [self._work.tap, self._work.share])

    def _take(self, proposal: Proposal, part: tuple[int, int, int, int]) -> None:
        """Take a part of the samples from knots to costs."""
        first, groups, sample, samples = part
        proposal.sample(sample, samples)
        self._work.knots = proposal.knots
        inputs, outputs = [self.judge.view, self.costs.params], [self._work]
        if self._judges:
            inputs += [self._own, first, self._groups, self.shape.samples]
            outputs.append(self.judge.cost)
        else:
            inputs.append(first)
        self._launch(self._kernel, groups, inputs, outputs)
        self._finish(sample, samples)

    def _finish(self, first: int, count: int) -> None:
        total = self._work.total
        inputs = [total, self.judge.cost, self._staged, self.grid.weight, self.state.observed, first]
        self._launch(finish_kernel, count, inputs, [total, self.diverged, self.cost])

    def explain(self, sample: wp.array) -> None:
        """Write what each term added to the cost of a sample of every environment ``[E]``; capture-safe."""
        inputs = [self._work.total, sample, self.shape.samples]
        self._launch(explain_total_kernel, self.term_cost.shape, inputs, [self.term_cost])

    def rollouts(self, worlds: Sequence[int]) -> Trajectory:
        """Some rollouts of the last evaluation, by the plain kernels that the baked source is tested against.

        Args:
            worlds: Which worlds.
        """
        shape, layout = self.shape, self.layout
        with capturing:
            out = Trajectory.allocate(BatchSize(1, len(worlds), 1, shape.horizon), layout, 0, self.device)
            table = joint_table(layout, self.device, worlds=len(worlds))
            chosen = wp.array(list(worlds), dtype=int, device=self.device)
            inputs = [table, drives(layout, self.device), self._work, shape.samples, chosen]
            outputs = [out.control, out.joint_q, out.joint_qd, out.body_q, out.body_qd]
            self._launch(kinematic_rollout_kernel, len(worlds), inputs, outputs)
        return out

    def record(self, worlds: Sequence[int]) -> Trajectory:
        """What became of some worlds in the last evaluation, on the host."""
        return self.rollouts(worlds).of_worlds(range(len(worlds)))

    @property
    def total(self) -> wp.array:
        """Cost of each term of each sample over the horizon ``[term, W]``."""
        return self._work.total

    def overflow_message(self, bits: int) -> str:
        """Nothing can overflow."""
        return f"capacity bits {bits:#x}"

    def close(self) -> None:
        """Stop the threads."""
        self._crew.close()


def drives(layout: Layout, device: str) -> Drives:
    """What controls do to joints, on a device."""
    out = Drives()
    out.matrix = wp.array(layout.actuator_matrix, dtype=float, device=device)
    out.mode = wp.array([MODES[mode] for mode in layout.actuator_mode], dtype=int, device=device)
    out.dof = wp.array(layout.actuator_dof, dtype=int, device=device)
    out.coord = wp.array(layout.dof_coord[layout.actuator_dof], dtype=int, device=device)
    return out


def _refuse(request: EngineRequest) -> None:
    """What has no meaning without physics is an error.

    Raises:
        SceneError: If the scene asks for it.
    """
    layout, costs = request.costs.layout, request.costs
    wheels = (np.count_nonzero(layout.actuator_matrix, axis=1) > 1).any()
    forces = any(mode not in MODES for mode in layout.actuator_mode)
    reasons = (
        ("robot.drive", any(request.compiled.actuator_name), "actuators of MJCF files: give the robot a drive"),
        ("robot.drive.mode", forces or wheels, "forces: neither efforts nor wheels that roll on a floor"),
        ("cost", bool(costs.pairs), "contact forces, which a cost term reads"),
        ("cost", bool(costs.sensors), "sensors, which a cost term reads"),
        ("planner.domains", request.shape.domains > 1, "physical properties to draw: set domains = 1"),
    )
    for key, wrong, what in reasons:
        if wrong:
            raise SceneError(f"the engine kinematic has no {what}", key=key, file=request.scene.path)
