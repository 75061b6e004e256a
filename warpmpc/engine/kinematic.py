# SPDX-License-Identifier: Apache-2.0
"""The engine ``kinematic``: no physics; joints follow the controls, and terms are evaluated in the launch (STORM).

Thousands of samples take less than a millisecond: one launch takes them from knots to costs, with the robot and most
terms written out as straight-line source (``warpmpc.physics.runtime.bake``). Terms without such a form are called in
the same launch on what it records. What is not driven stands still where it is observed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..cost.code.state import StateCode, moving_dofs
from ..kernels.engine.kinematic import (
    ACCELERATION,
    POSITION,
    VELOCITY,
    Drives,
    KinematicWork,
    kinematic_rollout_kernel,
    kinematic_step_kernel,
)
from ..physics.runtime.bake import WIDE
from ..physics.runtime.launch import capturing
from ..physics.runtime.thread_pool import thread_count
from ..scene.errors import SceneError
from ..scene.model.joints import joint_table
from ..scene.model.trajectory import BatchSize, Trajectory
from ..scene.schema_bodies import DriveMode
from .kinematic_source import WARP, RolloutSource
from .launched import LaunchedEngine, launch_terms
from .step_worlds import ConvertedWorlds

if TYPE_CHECKING:
    from ..scene.model.layout import Layout
    from .protocol import EngineRequest, PhysicsSteps
    from .step_worlds import Residuals

MODES = {"velocity": int(VELOCITY), "position": int(POSITION), "acceleration": int(ACCELERATION)}


class KinematicWorlds(ConvertedWorlds):
    """Worlds of the engine ``kinematic``."""

    def __init__(self, request: EngineRequest, steps: PhysicsSteps, worlds: int, residuals: Residuals):
        super().__init__(request, steps, worlds, residuals)
        self._drives, self._dt = drives(request.costs.layout, self.device), float(request.grid.dt[0])
        threads = thread_count(request.scene.engine.threads)
        self._bind_rows(0 if self._on_gpu else threads)

    def _advance(self, first: int, count: int) -> None:
        """Take the step from slice 0 of the record to slice 1, in some worlds."""
        out = self.trajectory
        outputs = [out.joint_q, out.joint_qd, out.body_q, out.body_qd]
        self._launch(kinematic_step_kernel, count, [self._table, self._drives, out.control, self._dt, first], outputs)


class KinematicEngine(LaunchedEngine):
    """Rolls knots out by kinematics alone and evaluates the terms in the same launch.

    Args:
        request: What the engine is built for.

    Raises:
        SceneError: If the scene asks for what has no meaning without physics.
    """

    name = "kinematic"
    step_worlds = KinematicWorlds

    def __init__(self, request: EngineRequest):
        _refuse(request)
        super().__init__(request, KinematicWork)
        self._no_physics = self._zeros(0, dtype=int)
        writer = StateCode(self.layout, moving_dofs(self.layout), quaternions=True)
        in_launch, on_record = launch_terms(self.costs, writer, stage_risk=self._stage_risk)
        spline = request.spline
        source = RolloutSource(writer, in_launch, spline.kind, len(spline.time), self.lanes, bool(on_record)).write()
        self._allocate_record(on_record)
        options = {"cpu_compiler_flags": (wp.config.cpu_compiler_flags or "") + WIDE} if self.lanes == 16 else {}
        shared = {"sharing": WARP if self._on_gpu else 1, "threads": 256, "options": options}
        self._compile(source, (self.costs.code.params, self.costs.params), **shared)

    @property
    def _failed(self) -> wp.array:
        """None: there is no physics."""
        return self._no_physics

    def rollouts(self, worlds: Sequence[int]) -> Trajectory:
        """Some rollouts of the last evaluation, by the plain kernels that the source is tested against.

        Args:
            worlds: Which worlds.
        """
        shape, layout = self.shape, self.layout
        with capturing:
            out = Trajectory.allocate(BatchSize(1, len(worlds), 1, shape.horizon), layout, 0, self.device)
            table = joint_table(layout, self.device, worlds=len(worlds))
            chosen = wp.array(list(worlds), dtype=int, device=self.device)
            inputs = [table, drives(layout, self.device), self._work, self.grid.dt, shape.samples, chosen]
            outputs = [out.control, out.joint_q, out.joint_qd, out.body_q, out.body_qd]
            self._launch(kinematic_rollout_kernel, len(worlds), inputs, outputs)
        return out

    def record(self, worlds: Sequence[int]) -> Trajectory:
        """States and controls of some worlds in the last evaluation, on the host."""
        return self.rollouts(worlds).of_worlds(range(len(worlds)))


def drives(layout: Layout, device: str) -> Drives:
    """Effect of controls on joints, on a device."""
    out = Drives()
    out.matrix = wp.array(layout.actuator_matrix, dtype=float, device=device)
    out.mode = wp.array([MODES[mode] for mode in layout.actuator_mode], dtype=int, device=device)
    out.dof = wp.array(layout.actuator_dof, dtype=int, device=device)
    out.coord = wp.array(layout.dof_coord[layout.actuator_dof], dtype=int, device=device)
    return out


def _refuse(request: EngineRequest) -> None:
    """Refuse what has no meaning without physics."""
    layout, costs = request.costs.layout, request.costs
    wheels = (np.count_nonzero(layout.actuator_matrix, axis=1) > 1).any()
    forces = any(mode not in MODES for mode in layout.actuator_mode)
    mocap = [r.name for r in request.scene.robot if any(d.mode is DriveMode.MOCAP for d in r.drive)]
    reasons = (
        (f"robot.{'.'.join(mocap[:1])}.drive.mode", bool(mocap), "welds, by which a mocap body leads a hand"),
        ("robot.drive", any(request.compiled.actuator_name), "actuators of MJCF files: give the robot a drive"),
        ("robot.drive.mode", forces or wheels, "forces: neither efforts nor wheels that roll on a floor"),
        ("cost", bool(costs.pairs), "contact forces, which a cost term reads"),
        ("cost", bool(costs.sensors), "sensors, which a cost term reads"),
        ("planner.domains", request.shape.domains > 1, "physical properties to draw: set domains = 1"),
    )
    for key, wrong, what in reasons:
        if wrong:
            raise SceneError(f"the engine kinematic has no {what}", key=key, file=request.scene.path)
