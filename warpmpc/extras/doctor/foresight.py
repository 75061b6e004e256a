# SPDX-License-Identifier: Apache-2.0
"""States and costs that a planner foresees for the controls that a run sent, beside those that came."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import mujoco
import numpy as np
import warp as wp

from ...cost.stack import CostStack
from ...engine.protocol import EngineRequest, Proposal, TimeGrid
from ...engine.registry import make_engine, physics_steps
from ...loop.plant.worlds import SOLVER, SUBSTEPS
from ...physics.runtime.launch import capturing
from ...planner.splines import spline_table
from ...scene.model.conversion import StateRows
from ...scene.model.mujoco_model import make_world
from ...scene.model.properties import Properties, draw_properties, with_factors
from ...scene.model.trajectory import BatchSize
from ...scene.schema import EngineName, Solver, SplineKind
from ...scene.task.observed import ObservedState
from ...scene.task.task import Task, task_layout

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...scene.model.compiled import CompiledScene
    from ...scene.model.layout import Layout
    from ...scene.schema import EngineSettings, Scene

AHEAD = 0.2
"""Time after which a predicted state is compared with the one that came [s]."""
STARTS = 48
"""Moments of a run from which controls are rolled out."""
STILL = 1e-3
"""Movement that counts in a run that stands still [m or rad]."""
WORST = 10.0
"""Largest error of one moment, as a multiple of the mean movement: a rollout that diverged."""


class RunTables(Protocol):
    """Parts of a :class:`~warpmpc.RunLog` that tell what a run did."""

    real_time: bool
    origin: Mapping[str, Any] | None
    states: np.recarray
    controls: np.recarray
    plans: np.recarray


@dataclass(frozen=True, kw_only=True)
class Steps:
    """N controls of a run, the true states around them, and the observations they were planned from."""

    joint_q: np.ndarray
    """True joint coordinates ``[N+1, nq]``, one before each control and one at the end."""
    joint_qd: np.ndarray
    """True joint velocities ``[N+1, nv]``."""
    control: np.ndarray
    """Controls ``[N, nu]``."""
    seen_q: np.ndarray
    """Observed joint coordinates ``[N, nq]``."""
    seen_qd: np.ndarray
    """Observed joint velocities ``[N, nv]``."""
    seen: np.ndarray
    """Index of the state that each observation is of ``[N]``."""
    act: np.ndarray
    """Observed activations ``[N, na]``."""
    mocap: np.ndarray
    """Observed poses of mocap bodies ``[N, nm, 7]``."""
    task: np.ndarray
    """Rows of ``Task.block`` ``[N, n]``."""

    def start(self, rows: np.ndarray, *, noise: bool = True, delay: bool = True) -> tuple[np.ndarray, ...]:
        """States that predictions at some controls begin in: coordinates, velocities, activations, mocap bodies.

        Args:
            rows: Indices of the controls.
            noise: Whether they are the observed states, else the true ones.
            delay: Whether they are as old as the observations.
        """
        latest = {int(index): row for row, index in enumerate(self.seen)}
        rows = rows if delay else np.array([latest[int(n)] for n in rows])
        q, qd = (self.seen_q, self.seen_qd) if noise else (self.joint_q[self.seen], self.joint_qd[self.seen])
        return q[rows], qd[rows], self.act[rows], self.mocap[rows]

    def windows(self, count: int) -> np.ndarray:
        """Controls that so many others follow, and whose state was observed sooner or later, :data:`STARTS` at most."""
        known = set(self.seen.tolist())
        rows = np.array([n for n in range(len(self.control) - count + 1) if n in known], dtype=int)
        return rows[np.unique(np.linspace(0, len(rows) - 1, min(STARTS, len(rows))).astype(int))] if len(rows) else rows


def logged_steps(log: RunTables, scene: Scene) -> Steps:
    """Controls, states and observations of a :class:`~warpmpc.RunLog`.

    Raises:
        ValueError: If it was in real time, or lacks what its plans were made from.
    """
    if log.real_time:
        raise ValueError("it was in real time: take a run without --real-time")
    if log.origin is None or "joint_q" not in (log.plans.dtype.names or ()) or not len(log.controls):
        raise ValueError("it has no log of what its plans were made from: run it again with --npz or --out")
    plans = log.plans[: len(log.controls)]
    return Steps(
        joint_q=log.states.joint_q,
        joint_qd=log.states.joint_qd,
        control=log.controls.control,
        seen_q=plans.joint_q,
        seen_qd=plans.joint_qd,
        seen=np.round(plans.time / scene.timing.control_dt).astype(int),
        act=plans.act,
        mocap=plans.mocap,
        task=plans.task,
    )


@dataclass(frozen=True, kw_only=True)
class Physics:
    """Physics as a planner or a plant takes its steps."""

    settings: EngineSettings
    """Options of the solver."""
    substeps: int
    """Physics steps in a hold."""
    hold: int = 1
    """Controls whose mean is held during these steps: more than one where a physics step is longer than a control."""
    properties: Properties | None = None
    """One draw of physical properties; None for nominal ones."""

    @classmethod
    def of_planner(cls, scene: Scene, compiled: CompiledScene, engine: str) -> Physics:
        """Physics of a planner's rollouts, with steps that divide a control or are a multiple of it."""
        steps = physics_steps(engine, scene, compiled, TimeGrid.of(scene))
        ratio = scene.timing.control_dt / steps.length[0]
        count, hold = max(1, int(np.ceil(ratio - 1e-6))), max(1, round(1.0 / ratio))
        return cls(substeps=count, hold=hold, settings=scene.engine)

    @classmethod
    def of_plant(cls, scene: Scene, compiled: CompiledScene, seed: int) -> Physics:
        """Physics of the simulated plant of a seed."""
        layout = task_layout(compiled.layout, scene)
        drawn = draw_properties(scene, layout, 1, seed=2 * seed + 1) if scene.plant.randomize else None
        return cls(
            settings=scene.engine.model_copy(update={} if compiled.mjcf_robots else SOLVER),
            substeps=compiled.substeps(scene.plant.substeps, scene.timing.control_dt, SUBSTEPS),
            properties=with_factors(drawn, scene, layout),
        )


class StateDistance:
    """Distance of two joint coordinates each ``[N, nq]``: ``[N]`` [m, rad]; velocities jitter where things touch."""

    def __init__(self, compiled: CompiledScene, layout: Layout):
        world = make_world(compiled, timestep=0.002)
        self._model, self._rows, self._nv = world.model, StateRows(layout, world), layout.nv

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Measure."""
        model, rows = self._model, self._rows
        still = np.zeros((len(first), self._nv))
        found = np.zeros((len(first), model.nv))
        for out, a, b in zip(found, rows(first, still), rows(second, still), strict=True):
            mujoco.mj_differentiatePos(model, out, 1.0, a[: model.nq], b[: model.nq])
        return np.linalg.norm(found, axis=1)


class Windows:
    """Pieces of a run that are rolled out again: N moments, K controls each.

    Args:
        steps: The run.
        terms: Users' own cost terms that the scene names.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene, steps: Steps, terms: Sequence[UserTerm] = ()):
        self.scene, self.compiled, self.steps, self.terms = scene, compiled, steps, terms
        self.layout = task_layout(compiled.layout, scene)
        self.count = min(max(1, round(AHEAD / scene.timing.control_dt)), len(steps.control))
        self.rows = steps.windows(self.count)
        """Controls that the pieces begin with ``[N]``."""

    @cached_property
    def time(self) -> np.ndarray:
        """Times at which the pieces begin ``[N]`` [s]."""
        return self.rows * self.scene.timing.control_dt

    def controls(self, hold: int) -> np.ndarray:
        """Controls of the pieces, means of ``hold`` of them ``[K // hold, N, nu]``."""
        whole = self.steps.control[self.rows[None] + np.arange(self.count)[:, None]]
        slots = self.count // hold
        return whole[: slots * hold].reshape(slots, hold, len(self.rows), -1).mean(axis=1)

    def roll_out(
        self, physics: Physics, *, engine: str = "mujoco", device: str = "cpu", noise: bool = True, delay: bool = True
    ) -> Rolled:
        """Roll the pieces out.

        Args:
            physics: The physics.
            engine: Engine that takes its steps.
            device: Device of the engine.
            noise: Whether the pieces begin in what was observed, else in the true states.
            delay: Whether these are as old as the observations.

        Raises:
            SceneError: If the engine cannot do what the scene asks for.
        """
        hold = min(physics.hold, self.count)
        control, start = self.controls(hold), self.steps.start(self.rows, noise=noise, delay=delay)
        envs, step = len(self.rows), hold * self.scene.timing.control_dt
        settings = physics.settings.model_copy(update={"substeps": physics.substeps})
        grid = TimeGrid(np.full(len(control), step), np.ones(len(control), dtype=np.float32))

        def array(values: np.ndarray) -> wp.array:
            return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=float, device=device)

        with capturing:  # nothing may be allocated while a controller records its plan
            task = Task(self.scene, envs=envs)
            for e, row in enumerate(self.steps.task[self.rows]):
                task.follow(row, e)
            costs = CostStack(self.scene, self.layout, task, terms=self.terms, device=device)
            state = ObservedState.allocate(self.layout, task, device)
            for to, values in zip((state.joint_q, state.joint_qd, state.act, state.mocap), start, strict=True):
                to.assign(np.ascontiguousarray(values, dtype=np.float32))
            state.start.assign(self.time.astype(np.float32))
            state.last_control.assign(self.steps.control[np.maximum(self.rows - 1, 0)].astype(np.float32))
            request = EngineRequest(
                scene=self.scene.model_copy(update={"engine": settings}),
                compiled=self.compiled,
                shape=BatchSize(envs, 1, 1, len(control)),
                grid=grid,
                spline=spline_table(SplineKind.ZERO, grid.t[:-1], step, device),
                limits=(array(self.layout.control_lower), array(self.layout.control_upper)),
                state=state,
                costs=costs,
                device=device,
                properties=physics.properties,
            )
            _, made = make_engine(engine, request)
            costs.refresh()
            costs.before_plan(state)
            made.evaluate(Proposal(array(control.swapaxes(0, 1)[:, None]), array(np.zeros(envs)), 1))
            rolled = Rolled(made.record(range(envs)).joint_q[1:].copy(), hold, made.cost.numpy()[:, 0] / len(control))
            made.close()
        return rolled

    @cached_property
    def distance(self) -> StateDistance:
        """Distance of states."""
        return StateDistance(self.compiled, self.layout)

    def error(self, rolled: Rolled, slot: int = -1) -> np.ndarray:
        """Error of predicted states after a slot of controls, as a share of how far the state moved ``[N]``."""
        after = self.rows + (slot % len(rolled.joint_q) + 1) * rolled.hold
        came = self.steps.joint_q[after]
        moved = self.distance(self.steps.joint_q[self.rows], came)
        return share_of_movement(self.distance(rolled.joint_q[slot], came), moved)


def share_of_movement(error: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Errors of predicted states as shares of how far states moved on average, :data:`WORST` at most.

    Args:
        error: Distance of each predicted state from the one that came ``[N]``.
        moved: Distance of that from the state at the beginning ``[N]``.
    """
    share = error / (np.mean(moved) + STILL)
    return np.where(np.isfinite(share), np.minimum(share, WORST), WORST)


@dataclass(frozen=True)
class Rolled:
    """States and costs of pieces of a run that were rolled out."""

    joint_q: np.ndarray
    """Joint coordinates after each slot ``[T, N, nq]``."""
    hold: int
    """Controls in a slot."""
    cost: np.ndarray
    """Weighted cost of every piece, the mean over its slots ``[N]``; infinite where it diverged."""


@dataclass(frozen=True, kw_only=True)
class Foresight:
    """Error of what a run's planner predicted; shares of how far the state moved and of what was paid."""

    state: float
    """Error of the state after one control."""
    ahead: float
    """Error of the state after :data:`AHEAD`."""
    cost: float
    """Error of the cost until then."""
    time: np.ndarray
    """Moments of the predictions ``[N]`` [s]."""
    errors: np.ndarray
    """Errors of the state after :data:`AHEAD` at them ``[N]``."""

    @property
    def numbers(self) -> dict[str, float]:
        """The three errors by name, as results have them."""
        return {"state": self.state, "state_ahead": self.ahead, "cost": self.cost}


def takes_mujoco_steps(engine: str, scene: Scene) -> bool:
    """Return whether an engine's physics is MuJoCo's."""
    newton = engine == EngineName.NEWTON and scene.engine.solver is Solver.MUJOCO
    return newton or engine in (EngineName.FUSED, EngineName.MUJOCO, EngineName.MUJOCO_WARP)


def foresee(
    scene: Scene,
    compiled: CompiledScene,
    steps: Steps,
    *,
    seed: int,
    engine: str,
    device: str = "cpu",
    terms: Sequence[UserTerm] = (),
) -> Foresight | None:
    """Compare what a run's planner predicted for the controls sent with what came; None for a run without any.

    Args:
        scene: The scene, drawn for the run.
        compiled: The scene, compiled.
        steps: The run.
        seed: Seed of the plant.
        engine: Engine that planned; one that takes MuJoCo's steps. Without a GPU MuJoCo replaces what is slow there.
        device: Device that it planned on; the CPU where that is missing.
        terms: Users' own cost terms that the scene names.
    """
    device = device if device == "cpu" or wp.is_cuda_available() else "cpu"
    slow = device == "cpu" and engine in (EngineName.MUJOCO_WARP, EngineName.NEWTON)
    same = str(EngineName.MUJOCO) if slow else engine
    windows = Windows(scene, compiled, steps, terms)
    if not len(windows.rows):
        return None
    planned = windows.roll_out(Physics.of_planner(scene, compiled, engine), engine=same, device=device)
    came = windows.roll_out(Physics.of_plant(scene, compiled, seed), noise=False, delay=False)
    errors = windows.error(planned)
    known = np.isfinite(planned.cost) & np.isfinite(came.cost)
    missed, paid = np.abs(planned.cost - came.cost)[known].sum(), np.abs(came.cost)[known].sum()
    return Foresight(
        state=float(windows.error(planned, 0).mean()),
        ahead=float(errors.mean()),
        cost=float(missed / paid) if paid else 0.0,
        time=windows.time,
        errors=errors,
    )
