# SPDX-License-Identifier: Apache-2.0
"""The engine ``fused``: MuJoCo's physics and the cost terms in one launch, with worlds in the lanes of a register."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.engine.launch import TAPS
from ..kernels.planner.splines import LINEAR, ZERO
from ..physics.runtime.launch import capturing
from ..physics.runtime.thread_pool import PARTS, ThreadPool, thread_count
from ..physics.source_parts import WARP, RolloutWork, options
from ..scene.model.trajectory import BatchSize, Trajectory
from .fused_physics import FusedPhysics
from .fused_state import PhysicsState, cost_code
from .launch_kernel import RECORDS_ALONE
from .launched import LaunchedEngine, launch_terms
from .step_worlds import LEAD, StepWorlds

if TYPE_CHECKING:
    from ..physics.source_parts import AddedCode
    from .protocol import EngineRequest, PhysicsSteps
    from .step_worlds import Residuals

KNOTS = {int(ZERO): 1, int(LINEAR): 2}
"""Most knots that a control depends on, by the kind of spline; :data:`TAPS` for all others."""


class FusedWorlds(StepWorlds):
    """Worlds of the engine ``fused``, in single precision."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        one, step = request.one_step(steps, worlds)
        given = {"device": request.device, "sensors": request.costs.sensors, "own_start": True, **one.worlds(step)}
        self._physics = physics = FusedPhysics(one.scene, one.compiled, one.shape, **given)
        super().__init__(request, worlds, residuals, physics.world)
        physics.trajectory = self._recorded
        physics.clone(self._state)
        work, nu, shape = physics.work, request.costs.layout.nu, self.shape
        work.knots = self._whole.control[LEAD].reshape((shape.envs, worlds, 1, nu))
        threads = thread_count(request.scene.engine.threads)
        self._groups = self._split(threads)
        parts = [(first, count) for _, _, first, count in self._groups]
        ends = work.reached.reshape((shape.worlds, 1, work.reached.shape[1]))
        self._bind(work.initial, ends, parts, None if self._on_gpu else ThreadPool(threads, len(parts)))

    def _split(self, threads: int) -> list[tuple[int, int, int, int]]:
        """First group of lanes, groups, first world and worlds of each part."""
        shape, lanes = self.shape, self._physics.lanes
        if self._on_gpu:
            return [(0, shape.worlds, 0, shape.worlds)]
        groups = -(-shape.samples // lanes)
        size = groups if threads == 1 else max(1, -(-groups * shape.envs // (PARTS * threads)))
        out = []
        for e in range(shape.envs):
            for first in range(0, groups, size):
                count = min(size, groups - first)
                end = min((first + count) * lanes, shape.samples)
                out.append((e * groups + first, count, e * shape.samples + first * lanes, end - first * lanes))
        return out

    def follow(self) -> None:
        """Take over nothing: the observed arrays are read at every step."""

    def take(self, part: int) -> None:
        """Take the step in a part of the worlds; capture-safe."""
        first, groups, world, worlds = self._groups[part]
        self._physics.launch(first, groups)
        self._write_residuals(world, worlds)


class FusedEngine(LaunchedEngine):
    """Rolls knots out with physics and evaluates the terms in the same launch.

    Terms with source are summed after every control, for all worlds of a register at once, and nothing is recorded. For
    other terms all worlds are recorded, and the launch evaluates the record at its end; so it does with all terms on a
    GPU, but that another launch evaluates them where each world has one thread.

    Args:
        request: What the engine is built for.
        steps: Physics steps.

    Raises:
        SceneError: If the scene asks for what this engine lacks.
    """

    name = "fused"
    step_worlds = FusedWorlds

    def __init__(self, request: EngineRequest, steps: PhysicsSteps):
        given = {"device": request.device, "sensors": request.costs.sensors, **request.worlds(steps)}
        self.physics = physics = FusedPhysics(request.scene, request.compiled, request.shape, **given)
        self.mj_model = physics.world.model
        super().__init__(request, RolloutWork)
        self.redraw = physics.redraw
        work = self._work
        work.act, work.pose, work.domains = self.state.act, self.state.pose, self.shape.domains
        work.diverged, work.overflow = self.diverged, self.overflow
        written, on_record = self._bake()
        # a thread for each step keeps a GPU busier than one for all steps of a world, as rollouts have it then
        self._allocate_record(on_record, apart=self._on_gpu and physics.sharing == 1)
        work.records, work.force = int(self.records), self.recorded.contact_force
        work.record_act, work.sensor = self.recorded.act, self.recorded.sensor
        source = physics.source(added=written, knots=KNOTS.get(request.spline.kind, int(TAPS)))
        physics.fill(work)
        code, params = (self.costs.code, self.costs.params) if written else self.costs.code_of([])
        shared = {"sharing": physics.sharing, "threads": WARP, "options": options(self.lanes)}
        self._compile(source, (code.params, params), **shared)

    def _bake(self) -> tuple[AddedCode | None, list[int]]:
        """Terms that are part of the source, and the numbers of all others."""
        if self._on_gpu:
            return None, list(range(len(self.costs.terms)))
        writer = PhysicsState(self.layout, self.physics.map)
        terms, on_record = launch_terms(self.costs, writer, stage_risk=self._stage_risk)
        return cost_code(writer, terms) if terms else None, on_record

    def record(self, worlds: Sequence[int]) -> Trajectory:
        """States and controls of some worlds in the last evaluation, on the host; rolled out again if not recorded."""
        if self.records:
            return super().record(worlds)
        rows, place = self._side_by_side(worlds)
        shape, layout, pairs = self.shape, self.layout, len(self.costs.pairs)
        with capturing:
            out = Trajectory.allocate(BatchSize(1, len(rows), 1, shape.horizon), layout, pairs, self.device)
            if rows:
                groups = len(rows) // (1 if self._on_gpu else self.lanes)
                self._start(self._recording(rows, out), 0, groups, RECORDS_ALONE)
        return out.of_worlds(place)

    def _recording(self, rows: list[int], out: Trajectory) -> RolloutWork:
        """Work of a launch that does nothing but record worlds."""
        work = RolloutWork()
        for name in RolloutWork.vars:
            setattr(work, name, getattr(self._work, name))
        work.chosen, work.records = wp.array(rows, dtype=int, device=self.device), 1
        work.control, work.force, work.diverged, work.overflow = (
            out.control,
            out.contact_force,
            out.diverged,
            out.overflow,
        )
        work.record_q, work.record_qd, work.sensor = out.joint_q, out.joint_qd, out.sensor
        work.record_body_q, work.record_body_qd, work.record_act = out.body_q, out.body_qd, out.act
        return work

    def _side_by_side(self, worlds: Sequence[int]) -> tuple[list[int], list[int]]:
        """Worlds in whole groups of one environment each, the last ones repeated, and where each of them is."""
        lanes = 1 if self._on_gpu else self.lanes
        order = sorted(range(len(worlds)), key=lambda i: int(worlds[i]) // self.shape.rollouts)
        rows: list[int] = []
        place = np.zeros(len(worlds), dtype=int)
        for _, group in groupby(order, key=lambda i: int(worlds[i]) // self.shape.rollouts):
            for i in group:
                place[i] = len(rows)
                rows.append(int(worlds[i]))
            rows += rows[-1:] * (-len(rows) % lanes)
        return rows, place.tolist()

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed."""
        return (
            'more contacts at once than the engine fused has room for: engine.name = "mujoco" has room for all, fewer '
            "or simpler collision shapes need less"
        )
