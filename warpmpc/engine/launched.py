# SPDX-License-Identifier: Apache-2.0
"""Engines that roll out in one launch, and evaluate terms in it.

Places of cost terms: the launch, whose source they become part of, or the record.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..cost.code.state import Refused, TermCode, TermSource
from ..cost.term import ArrayCost, CostTerm
from ..cost.trace.tracer import trace
from ..kernels.engine.launch import TAPS, TermSums, taps_kernel
from ..kernels.planner.splines import ZERO
from ..physics.runtime.bake import Lines, OutOfRange, native_lanes
from ..physics.runtime.compiling import compile_made
from ..physics.runtime.thread_pool import PARTS, ThreadPool, thread_count
from ..scene.model.trajectory import BatchSize, Trajectory
from .evaluation import Part, RolloutEngine
from .launch_kernel import RECORDS_ALONE, make_kernel

if TYPE_CHECKING:
    from ..cost.code.state import StateCode
    from ..cost.stack import CostStack
    from ..physics.runtime.bake import Operand
    from ..physics.runtime.launch import CapturedLaunches
    from .protocol import EngineRequest, Proposal


class LaunchedEngine(RolloutEngine):
    """Rolls knots out in one launch, which sums the terms that are part of its source.

    A subclass writes the source and calls :meth:`_compile`.

    Args:
        request: What the engine is built for.
        work: ``wp.struct`` that its kernel takes, with the fields of ``KinematicWork`` that are filled here.
    """

    def __init__(self, request: EngineRequest, work: Any):
        super().__init__(request)
        self.lanes, shape, zeros = native_lanes(), self.shape, self._zeros
        self.diverged, self.overflow = zeros(shape.worlds, dtype=int), zeros(shape.worlds, dtype=int)
        knots = len(request.spline.time)
        self._work_type, work = work, work()
        self._unit = wp.array(np.eye(knots)[:, :, None], dtype=float, device=self.device)
        work.tap = zeros(shape.envs, shape.horizon, int(TAPS), dtype=int)
        work.share = zeros(shape.envs, shape.horizon, int(TAPS))
        work.lower, work.upper = request.limits
        state, self._work, self._sums = self.state, work, TermSums()
        work.joint_q, work.joint_qd, work.mocap = state.joint_q, state.joint_qd, state.mocap
        sums = self._sums
        sums.dt, sums.weights, sums.total = self.grid.dt, self.weights, self.total
        # only knots that stand still between plans change their part in a step's control
        self._taps_move = request.spline.kind == int(ZERO) and request.spline.even != 0
        self._write_taps(zeros(shape.envs))
        self.threads = 1 if self._on_gpu else thread_count(request.scene.engine.threads)
        # rounds that try fewer samples may leave gaps, and a part more, between environments
        most = PARTS * self.threads + shape.envs
        self._pool = ThreadPool(min(self.threads, len(self._split(shape.samples))), most)

    def _allocate_record(self, on_record: Sequence[int], *, apart: bool = False) -> None:
        """Make a record of all worlds for terms that are no part of the source, if there are any."""
        shape, work = self.shape if on_record else BatchSize(1, 1, 1, self.shape.horizon), self._work
        out = Trajectory.allocate(shape, self.layout, len(self.costs.pairs), self.device)
        work.record_q, work.record_qd, work.control = out.joint_q, out.joint_qd, out.control
        work.record_body_q, work.record_body_qd = out.body_q, out.body_qd
        self._place_terms(on_record, out, shape, apart=apart)
        kernels = [i for i in on_record if isinstance(self.costs.terms[i][0], CostTerm)]
        self._code, self._own = self.costs.code_of([] if apart else kernels)
        self._evaluates = bool(kernels) and not apart

    def _compile(self, source: str, terms: tuple[Any, Any], *, sharing: int, threads: int, options: dict) -> None:
        """Compile the launch.

        Args:
            source: Source of rollouts with terms.
            terms: Struct of the parameters of these terms, and the parameters.
            sharing: Threads that share a world on a GPU, else 1.
            threads: Threads of a block on a GPU.
            options: Options of the kernel's module.
        """
        self._sharing, self._threads, (struct, self._params) = sharing, threads, terms
        make = partial(make_kernel, source, self._work_type, struct, self._code, lanes=self.lanes, sharing=sharing)
        what = f"the rollouts of {self.request.scene.name}"
        self._kernel = compile_made(make, options, self.device, threads, what, source=source)

    def _split(self, samples: int) -> list[Part]:
        """Parts that together try the first samples of every environment.

        Args:
            samples: How many; on the CPU whole registers of them, on a GPU all where there are several environments.
        """
        shape = self.shape
        if self._on_gpu:
            tried = samples if shape.envs == 1 else shape.envs * shape.samples
            return [Part(0, tried * shape.domains, 0, tried)]
        groups = -(-shape.rollouts // self.lanes)
        # all domains of a sample belong to one part
        whole = int(np.lcm(self.lanes, shape.domains)) // self.lanes
        blocks = -(-groups // whole)
        tried = -(-samples * shape.domains // (whole * self.lanes))
        count = tried * shape.envs
        size = count if self.threads == 1 else max(1, -(-count // (PARTS * self.threads)))

        def group(block: int) -> int:
            return block // blocks * groups + block % blocks * whole

        def sample(block: int) -> int:
            return block // blocks * shape.samples + block % blocks * whole * self.lanes // shape.domains

        parts = []
        # where all are tried, environments lie side by side without a gap
        runs = [(0, count)] if tried == blocks else [(e * blocks, e * blocks + tried) for e in range(shape.envs)]
        for begin, stop in runs:
            for first in range(begin, stop, size):
                end = min(first + size, stop)
                parts.append(Part(group(first), group(end) - group(first), sample(first), sample(end) - sample(first)))
        return parts

    def _run(self, replays: Sequence[CapturedLaunches]) -> None:
        self._pool.run(replays)

    def _begin(self, proposal: Proposal) -> None:
        """Write which knots the controls depend on at present, where that changes."""
        if self._taps_move:
            self._write_taps(proposal.offset)

    def _write_taps(self, offset: wp.array) -> None:
        inputs = [self._unit, self.request.spline, self.grid.t, self._step_place, offset]
        self._launch(taps_kernel, self._work.tap.shape[:2], inputs, [self._work.tap, self._work.share])

    def _simulate(self, proposal: Proposal, part: Part) -> None:
        """Roll some groups of lanes out, on a GPU all worlds."""
        self._work.knots = proposal.knots
        groups = 0 if self._on_gpu else -(-self.shape.rollouts // self.lanes)
        self._start(self._work, part.first, part.count, groups if self._evaluates else RECORDS_ALONE)

    def _start(self, work: Any, first: int, count: int, groups: int) -> None:
        inputs = [self.evaluator.view, self._params, self._own, first, groups, self.shape.rollouts]
        outputs = [work, self._sums, self.evaluator.cost]
        self._launch(self._kernel, count * self._sharing, inputs, outputs, threads=self._threads)

    def close(self) -> None:
        """Stop the threads."""
        self._pool.close()


logger = logging.getLogger("warpmpc")

_ON_RECORD = "cost term '%s' is evaluated on the record, not in the launch: %s"


def launch_terms(
    costs: CostStack, state: StateCode, *, stage_risk: float = 0.0
) -> tuple[tuple[TermSource, ...], list[int]]:
    """Source of all terms that can be written, and the numbers of those that cannot.

    Args:
        costs: The terms.
        state: What they may ask about a state, in which they leave what they share.
        stage_risk: R of ρ(l; R), which needs all terms of a step together: none is written where it is not zero.
    """
    in_launch, on_record = [], []
    for i, (term, bound) in enumerate(costs.terms):
        code = TermCode(state, Lines(f"t{i}_"), f"p.p{i}")
        value = term_source(code, term, bound, costs.labels[i]) if stage_risk == 0.0 else None
        if value is None:
            on_record.append(i)
        else:
            in_launch.append(TermSource(i, code.lines, value))
    return tuple(in_launch), on_record


def term_source(code: TermCode, term: CostTerm | ArrayCost, bound: Any, label: str) -> Operand | None:
    """Write a term as source: by hand where it has such a form, else traced; None where neither can be.

    Args:
        code: Where the source is written.
        term: The term.
        bound: Its filled parameter struct.
        label: What the log calls it.
    """
    if not isinstance(term, CostTerm):
        logger.info(_ON_RECORD, label, "it is a function of whole arrays")
        return None
    try:
        value = term.source(code, bound) if term.source else None
        return trace(code, term.function, bound) if value is None else value
    except (OutOfRange, Refused) as error:
        logger.info(_ON_RECORD, label, error)
        return None
