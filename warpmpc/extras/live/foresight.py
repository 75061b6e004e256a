# SPDX-License-Identifier: Apache-2.0
"""Comparison of what the planner predicted for the controls sent with what came, while a run goes on.

Cost of the last plan's cheapest rollout at every step, term by term.

Rollouts of the last plan: paths to draw, and the cost of the cheapest one step by step.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...cost.stack import CostEvaluator
from ...engine.mujoco import MujocoSimulator
from ...physics.runtime.launch import capturing
from ...planner.controller.rollout_paths import RolloutPaths, acting_frames, see_rollouts
from ...scene.model.mujoco_model import Options
from ...scene.model.trajectory import BatchSize, Trajectory
from ...scene.task.observed import ObservedState
from ...scene.task.task import Task
from ..doctor.foresight import AHEAD, Physics, StateDistance, share_of_movement, takes_mujoco_steps

if TYPE_CHECKING:
    from ...loop.plant.plant import Plant
    from ...planner.controller.controller import Controller
    from ...scene.model.state import State


@dataclass(frozen=True)
class Forecast:
    """The cheapest rollout ahead; arrays are copies."""

    times: np.ndarray
    """Begin of every step ``[T]`` [s]."""
    cost: np.ndarray
    """Weighted cost of every term and step, not discounted ``[terms, T]``; NaN where it is not finite."""
    control: np.ndarray
    """Controls ``[T, nu]``."""


class TrajectoryCosts:
    """Evaluates one recorded rollout step by step, with the terms, resources and weights of the last plan.

    Args:
        controller: The controller.
        times: Begin of every step and end of the last after the first ``[T+1]`` [s].
        state: Start of the rollout.
    """

    def __init__(self, controller: Controller, times: np.ndarray, state: ObservedState):
        costs, shape = controller.costs, BatchSize(1, 1, 1, len(times) - 1)
        with capturing:
            self._out = Trajectory.allocate(shape, controller.layout, len(costs.pairs), controller.device)
            self._evaluator = CostEvaluator(costs, self._out, self._out.control, state, shape, times)

    def __call__(self, seen: Trajectory) -> np.ndarray:
        """Compute the weighted cost of every term and step, not discounted ``[terms, T]``.

        Args:
            seen: Recorded rollouts on the host; the first of them is evaluated.
        """
        for field in fields(Trajectory):
            values = getattr(seen, field.name)
            first = values[:1] if values.ndim == 1 else values[:, :1]
            with capturing:
                getattr(self._out, field.name).assign(np.ascontiguousarray(first))
        self._evaluator.launch()
        self._evaluator.launch_arrays()
        return self._evaluator.cost.numpy()[:, :, 0].astype(float)


class Forecaster:
    """Evaluates the cheapest rollout step by step."""

    def __init__(self, controller: Controller):
        self._controller, planner = controller, controller.plan_step
        self._costs = TrajectoryCosts(controller, planner.grid.t, planner.state)

    def __call__(self, seen: Trajectory) -> Forecast:
        """Compute the cost ahead.

        Args:
            seen: Recorded rollouts on the host; the first of them is evaluated.
        """
        cost = self._costs(seen)
        return Forecast(
            times=self._controller.info.time + self._controller.plan_step.grid.t[:-1],
            cost=np.where(np.isfinite(cost), cost, np.nan),
            control=seen.control[:, 0].copy(),
        )


class ShownRollouts:
    """Looks at rollouts of a controller's last plan."""

    paths: RolloutPaths | None
    """Paths to draw; None where no rollout survived."""
    forecast: Forecast | None
    """Cost ahead of the cheapest rollout; None in the same cases."""

    def __init__(self, controller: Controller):
        self._controller = controller
        self._frames = acting_frames(controller.scene, controller.layout)
        self._forecaster = Forecaster(controller)
        self.clear()

    def clear(self) -> None:
        """There is nothing to see."""
        self.paths = self.forecast = None

    def update(self) -> None:
        """See what the last plan came to."""
        found = see_rollouts(self._controller, self._frames)
        if found is None:
            self.clear()
            return
        seen, self.paths = found
        self.forecast = self._forecaster(seen)


def segments(paths: np.ndarray) -> np.ndarray:
    """Lines ``[..., T+1, 3]`` cut into pieces ``[n, 2, 3]``."""
    return np.stack([paths[..., :-1, :], paths[..., 1:, :]], axis=-2).reshape(-1, 2, 3)


KEPT = 300
"""Comparisons of which the error is the mean."""


@dataclass(frozen=True)
class Foreseen:
    """Prediction of the last :data:`~warpmpc.extras.doctor.foresight.AHEAD`, and what came."""

    cost: float
    """Weighted cost foreseen, the mean over the steps; infinite where the rollout diverged."""
    came: float
    """Weighted cost of the states that came."""
    error: float
    """Mean error of the states foreseen so far, as a share of how far states moved."""


@dataclass(frozen=True)
class Sent:
    """A control, the true state before it, and the observation it was planned from."""

    control: np.ndarray
    true: State
    seen: State


class ForesightMeter:
    """Rolls the last controls out in the planner's physics, one world for all of them.

    That is one rollout of :data:`~warpmpc.extras.doctor.foresight.AHEAD` by MuJoCo, where a plan has hundreds of
    longer ones. The states that came get their costs from the planner's terms and resources, their forces from the
    plant's physics.

    Args:
        controller: The controller, of one environment.
        plant: Its plant.
    """

    def __init__(self, controller: Controller, plant: Plant):
        self.known = takes_mujoco_steps(controller.engine.name, controller.scene)
        """True where predictions can be made: the engine takes MuJoCo's steps."""
        self._controller, self._plant = controller, plant
        if self.known:
            with capturing:  # nothing may be allocated while a controller records its plan
                self._build()
        self.clear()

    def _build(self) -> None:
        controller, scene, compiled = self._controller, self._controller.scene, self._controller.compiled
        dt, ahead = scene.timing.control_dt, max(1, round(AHEAD / scene.timing.control_dt))
        planned = Physics.of_planner(scene, compiled, controller.engine.name)
        self._hold = min(planned.hold, ahead)
        slots = ahead // self._hold
        self._count = slots * self._hold
        self._distance = StateDistance(compiled, controller.layout)
        self._planned = Rollouts(controller, planned, 1, slots, self._hold * dt)
        real = Physics.of_plant(self._plant.scene, compiled, self._plant.seed)
        self._came = Rollouts(controller, real, self._count, 1, dt)
        state, device = controller.plan_step.state, controller.device
        self._state = replace(
            state,
            start=wp.zeros(1, dtype=float, device=device),
            last_control=wp.zeros((1, controller.layout.nu), dtype=float, device=device),
        )
        self._planned_costs = TrajectoryCosts(controller, self._hold * dt * np.arange(slots + 1), self._state)
        self._came_costs = TrajectoryCosts(controller, dt * np.arange(self._count + 1), self._state)

    def clear(self) -> None:
        """Begin anew, with another episode."""
        self._errors: deque[tuple[float, float]] = deque(maxlen=KEPT)
        self.forget()

    def forget(self) -> None:
        """Drop the controls so far: those to come do not follow them."""
        self._sent: deque[Sent] = deque(maxlen=self._count + 2 if self.known else 0)

    def note(self, control: np.ndarray, seen: State | None = None) -> None:
        """Keep a control ``[nu]``, before it is applied, and what was seen then; what was planned from if None."""
        if self.known:
            self._sent.append(Sent(np.array(control), self._plant.state, seen or self._controller.observed))

    def compare(self) -> Foreseen | None:
        """Compare what was foreseen for the controls sent last with what came; None where there are too few.

        Another thread than that of the plant may ask: what came is known to the newest control.
        """
        rows = list(self._sent)
        if not self.known or len(rows) < self._count + 2:
            return None
        before, *sent, newest = rows
        controls = np.array([row.control for row in sent])
        now = newest.true.joint_q[None]
        held = controls.reshape(-1, self._hold, controls.shape[1]).mean(axis=1)
        planned = self._planned([sent[0].seen], held[:, None])
        came = self._came([row.true for row in sent], controls[None])
        with capturing:
            self._state.start.assign(np.float32([sent[0].true.time]))
            self._state.last_control.assign(before.control[None].astype(np.float32))
        cost = math.inf if planned.diverged[0] else self._planned_costs(planned).sum(axis=0).mean()
        off, moved = (self._distance(q, now)[0] for q in (planned.joint_q[-1], sent[0].true.joint_q[None]))
        self._errors.append((off, moved))
        errors, movements = np.array(self._errors).T
        error = share_of_movement(errors, movements).mean()
        return Foreseen(float(cost), float(self._came_costs(_chained(came)).sum(axis=0).mean()), float(error))


class Rollouts:
    """Worlds of MuJoCo's C engine that take controls from given states.

    Args:
        controller: The controller, whose terms say which forces and sensors are recorded.
        physics: The physics.
        worlds: Number of worlds W.
        steps: Number of controls T.
        step: Their length [s].
    """

    def __init__(self, controller: Controller, physics: Physics, worlds: int, steps: int, step: float):
        self._task = controller.task
        self._start = ObservedState.allocate(controller.layout, Task(controller.scene, envs=worlds), "cpu")
        self._simulator = MujocoSimulator(
            controller.compiled,
            BatchSize(worlds, 1, 1, steps),
            substeps=[physics.substeps] * steps,
            timestep=step / physics.substeps,
            pairs=controller.costs.pairs,
            properties=physics.properties,
            threads=1,
            options=Options.of(physics.settings),
            sensors=controller.costs.sensors,
        )

    def __call__(self, states: list[State], control: np.ndarray) -> Trajectory:
        """Roll controls ``[T, W, nu]`` out from W states; the record is on the host."""
        start, simulator = self._start, self._simulator
        poses = self._task.block[:, : 7 * len(self._task.pose_name)].reshape(1, -1, 7)
        with capturing:
            for name in ("joint_q", "joint_qd", "act", "mocap"):
                getattr(start, name).assign(np.array([getattr(s, name) for s in states], dtype=np.float32))
            start.pose.assign(np.repeat(poses, len(states), axis=0))
            simulator.trajectory.control.assign(control.astype(np.float32))
            simulator.clone(start)
            simulator.rollout(simulator.trajectory.control)
        return simulator.trajectory.of_worlds(range(len(states)))


def _chained(record: Trajectory) -> Trajectory:
    """Worlds that took one control each, one after the other as one world that took them all."""

    def chained(values: np.ndarray) -> np.ndarray:
        if values.ndim == 1:
            return values[:1]
        rows = values[0] if len(values) == 1 else np.concatenate([values[0, :1], values[1]])
        return rows[:, None]

    return Trajectory(**{field.name: chained(getattr(record, field.name)) for field in fields(Trajectory)})
