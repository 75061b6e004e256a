# SPDX-License-Identifier: Apache-2.0
"""The controller: observe → plan → command."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...cost.stack import CostStack
from ...cost.trial import try_terms
from ...engine.registry import ENGINES, resolve
from ...physics.runtime.launch import capturing, one_thread
from ...scene.errors import SceneError
from ...scene.model.compiled import CompiledScene, compile_scene
from ...scene.model.control_values import safe_command
from ...scene.model.properties import draw_properties
from ...scene.model.state import Info, State
from ...scene.model.trajectory import BatchSize, require_memory
from ...scene.schema import SampleCount
from ...scene.task.task import AncillaryController, Task, task_layout
from ..plan import Plan, PlanReport, Rollout
from ..step import PlanGraph, PlanStep
from ..tumbles import bearable
from .observation import Observation

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...scene.schema import Scene

logger = logging.getLogger("warpmpc")


class Controller:
    """Plans the next control of a scene's robots from its observed state.

    With several environments it solves as many independent problems in one go: states, plans and controls then have
    a leading axis ``[E]``, and :attr:`info` is a tuple. All environments share noise and randomized worlds.

    One thread at a time uses a controller: a call while another thread is in one is a ``RuntimeError``.

    Args:
        scene: The scene.
        engine: Name of an engine, or ``"auto"``: the scene's, else ``fused`` where it can do what the scene asks for,
            else ``mujoco`` on the CPU and ``newton`` on a GPU.
        device: ``"cpu"``, a CUDA device such as ``"cuda:0"``, or ``"auto"``: a GPU where there is one. To take the
            faster one on this machine, ask :func:`warpmpc.choose_engine`.
        strategy: Name of a strategy, your own ones among them (:func:`warpmpc.planner.step.register`), or
            ``"auto"``: the scene's ``planner.method``.
        seed: Seed of noise and randomized worlds; on the CPU the same seed gives the same commands on the same machine.
        envs: Number of environments E.
        task: What the run wants, shared with its plant; a new one if None.
        terms: Users' own cost terms and ancillary controllers that the scene names.
        compiled: The scene compiled earlier, to save doing it again.

    Raises:
        SceneError: If the scene names anything that does not exist.
        ValueError: If the engine, device or strategy is unknown or not available here.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        engine: str = "auto",
        device: str = "auto",
        strategy: str = "auto",
        seed: int = 0,
        envs: int = 1,
        task: Task | None = None,
        terms: Sequence[UserTerm] = (),
        compiled: CompiledScene | None = None,
    ):
        if envs < 1:
            raise ValueError(f"a controller has at least one environment, not {envs}")
        if task is not None and task.envs != envs:
            raise ValueError(f"this task is one of {task.envs} environments, not of {envs}")
        if scene.planner.samples is SampleCount.AUTO:
            message = "a controller does not measure: warpmpc.fit_samples(scene) does"
            raise SceneError(message, key="planner.samples", file=scene.path, found="auto")
        self._in_use = threading.RLock()
        name, device = resolve(scene, engine, device)
        self.scene, self.seed, self.envs, self.strategy = scene, seed, envs, strategy
        self.compiled = compiled or compile_scene(scene)
        self.layout = task_layout(self.compiled.layout, scene)
        self.task = task or Task(scene, envs=envs)
        """Poses, scalars, weights and phase; what is changed there takes effect at the next plan."""
        try:
            with capturing:  # nothing may be allocated while another controller records its plan
                self._build(name, device, strategy, terms)
        except SceneError as error:
            error.file = error.file or scene.path
            raise
        self._observed = Observation(self.layout, envs, scene.timing.control_dt)
        self._lower, self._upper = self.layout.control_lower.copy(), self.layout.control_upper.copy()
        self._warned_of_overflow = False
        self._info: Info | tuple[Info, ...] | None = None
        self._forget()

    def _build(self, name: str, device: str, strategy: str, terms: Sequence[UserTerm]) -> None:
        self.scene, self.lowered = bearable(self.scene, self.compiled, name)
        """What the default noise and knots let turn over; None where nothing, or where the scene gives σ."""
        scene, seed, envs = self.scene, self.seed, self.envs
        planner = scene.planner
        self.shape = BatchSize(envs, planner.samples, planner.domains, planner.horizon)
        self._require_memory(device)
        self.costs = CostStack(scene, self.layout, self.task, terms=terms, device=device)
        try_terms(self.costs, scene)
        draws = planner.domains if planner.domains > 1 else planner.samples
        properties = draw_properties(scene, self.layout, draws, seed=2 * seed) if planner.randomize else None
        self.plan_step = PlanStep(
            scene,
            self.compiled,
            self.costs,
            self.shape,
            engine=name,
            strategy=strategy,
            seed=seed,
            properties=properties,
            ancillaries=[term for term in terms if isinstance(term, AncillaryController)],
        )
        self.engine = self.plan_step.engine
        self.graph = PlanGraph(self.plan_step)

    def _require_memory(self, device: str) -> None:
        """Refuse samples that do not fit; what the engine records it looks at itself."""
        shape, planner = self.shape, self.scene.planner
        knots = planner.knot_count or planner.horizon
        needed = 4 * shape.envs * shape.samples * knots * self.layout.nu * 3  # knots, noise as drawn, noise as shaped
        cure = "lower planner.samples, planner.knots or the number of environments"
        require_memory(needed, device, f"the knots of {shape.samples} samples", key="planner.samples", cure=cure)
        needed = 16 * knots * knots  # how knots hang together, twice
        require_memory(needed, "cpu", f"{knots} knots", key="planner.knots", cure="give planner.knots = 8 or so")

    def _forget(self) -> None:
        self._observed.forget()
        self._last: tuple[State, PlanReport, np.ndarray, float] | None = None
        self._info = None
        self._command: np.ndarray | None = None

    @property
    def device(self) -> str:
        """Device the rollouts run on."""
        return self.engine.device

    @property
    def info(self) -> Info | tuple[Info, ...] | None:
        """Numbers of the last plan, one per environment when there are several; None before the first."""
        if self._info is None and self._last is not None:
            state, report, fallback, plan_ms = self._last
            infos = tuple(self._describe(report, e, bool(fallback[e]), plan_ms) for e in range(self.envs))
            self._info = infos if np.ndim(state.joint_q) == 2 else infos[0]
        return self._info

    @property
    def command(self) -> np.ndarray | None:
        """Control that the last :meth:`step` returned, a copy; None before the first."""
        return None if self._command is None else self._command.copy()

    @property
    def observed(self) -> State:
        """The newest observation as it was taken in, with what it left out; finite or not."""
        return self._observed.newest(many=self._last is not None and np.ndim(self._last[0].joint_q) == 2)

    @property
    def planned_task(self) -> np.ndarray:
        """Values of the task (rows of ``Task.block``) that the last plan was made for ``[E, n]``, a copy."""
        return self.graph.task.copy()

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits of the controls ``[nu]`` each, copies."""
        return self._lower.copy(), self._upper.copy()

    @one_thread
    def set_limits(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Change the limits of the controls ``[nu]``; takes effect at the next plan.

        Raises:
            ValueError: If they have the wrong shape, are not finite, or cross.
        """
        lower, upper = np.asarray(lower, dtype=np.float32), np.asarray(upper, dtype=np.float32)
        right = lower.shape == upper.shape == (self.layout.nu,) and np.isfinite([lower, upper]).all()
        if not right or (lower >= upper).any():
            raise ValueError(f"limits are {self.layout.nu} finite numbers each, lower below upper")
        self._lower, self._upper = lower.copy(), upper.copy()
        with capturing:
            for array, values in zip(self.plan_step.limits, (lower, upper), strict=True):
                array.assign(values)
            self.plan_step.strategy.limit()

    @one_thread
    def reset(self, plan: Plan | None = None) -> None:
        """Forget every earlier plan and observation, as if just constructed; the task stays as it is.

        Args:
            plan: Where the next plan starts from, as if this had been the last one: it moves on by the time from the
                first of its knots to the next observation. It may come from another controller, with other knots. From
                nothing if None.

        Raises:
            ValueError: If it is a plan of other controls or of other environments.
        """
        if plan is not None:
            self._check_plan(plan)
        with capturing:
            self.plan_step.reset(plan)
        self._forget()
        if plan is not None:
            self._observed.resume(plan.times[..., 0])

    def _check_plan(self, plan: Plan) -> None:
        shape = (self.layout.nu,) if plan.knots.ndim == 2 else (self.envs, self.layout.nu)
        found = plan.knots.shape[:-2] + plan.knots.shape[-1:]
        if found != shape:
            raise ValueError(
                f"a plan here is of {self.layout.nu} controls for one or all of {self.envs} environments, "
                f"not of knots {list(plan.knots.shape)}"
            )

    @one_thread
    def step(self, state: State) -> np.ndarray:
        """Plan from an observed state and return the control to apply now.

        Args:
            state: Observed state, ``joint_q [nq]`` and ``joint_qd [nv]``; ``[E, nq]`` and ``[E, nv]`` with several
                environments. Plans move by the time between observations; without a time each counts as one control
                after the last.

        Returns:
            Control ``[nu]``, or ``[E, nu]``, within its limits: the plan's at the time of the state. Where no rollout
            survives (a diverged simulation, a NaN in the observation) it is the safe command: zero velocity, zero
            effort, or the position last seen; :attr:`info` says so and a warning is logged.

        Raises:
            ValueError: If the state has the wrong shape, or its first observation is not finite and a drive holds
                positions, so that there is none to hold.
        """
        start = time.perf_counter()
        seen = self._observed
        seen.take(state)
        if seen.fresh.any():
            report = self.graph(seen.fresh, seen.elapsed, seen.now, seen.block)
            command = report.command.copy()
        else:
            report, command = self._no_report(), np.zeros((self.envs, self.layout.nu), np.float32)
        fallback = ~(seen.fresh & np.isfinite(report.cost))
        if fallback.any():
            command[fallback] = self._safe_command(fallback)
            with capturing:
                self.plan_step.command.assign(command)
            why = "the observation is not finite" if not seen.fresh.all() else self._why_none(report, fallback)
            logger.warning("t = %.2f s: %s; sending the safe command", np.max(seen.now), why)
        plan_ms = 1e3 * (time.perf_counter() - start)
        if seen.fresh.any():
            self._warn_of_overflow(report)
        self._last, self._info = (state, report, fallback, plan_ms), None
        self._command = command if np.ndim(state.joint_q) == 2 else command[0]
        return self._command.copy()

    @one_thread
    def plan(self, state: State) -> Plan:
        """Plan from an observed state.

        Args:
            state: As for :meth:`step`, which this does.

        Returns:
            The plan, stamped with absolute times: ``plan.at(t)`` is the control at a time. Where :attr:`info` says
            ``fallback`` it is the earlier plan, and its controls are not to be trusted.

        Raises:
            ValueError: As :meth:`step`.
        """
        self.step(state)
        return self.newest_plan

    @property
    def newest_plan(self) -> Plan | None:
        """The plan of the last :meth:`step`, as :meth:`plan` returns it; None before the first."""
        if self._last is None:
            return None
        state, report = self._last[:2]
        many, gains = np.ndim(state.joint_q) == 2, self.plan_step.feedback
        times = (self._observed.last - report.offset)[:, None] + self.plan_step.plan_spline.times
        start = np.nan_to_num(self._observed.planned)
        return Plan(
            knots=report.knots.copy() if many else report.knots[0].copy(),
            times=times if many else times[0].copy(),
            spline=self.plan_step.plan_spline.kind,
            lower=self._lower.copy(),
            upper=self._upper.copy(),
            feedback=gains and replace(gains, times=start[:, None] + gains.times),
        )

    @one_thread
    def rollout(self, sample: int | None = None, *, e: int = 0) -> Rollout:
        """Rollout of one sample of the last plan: states, controls and knots over the horizon.

        Args:
            sample: Which one; the cheapest if None. Sample 0 is the mean as it was before this plan moved it.

        Raises:
            ValueError: If nothing has been planned yet, or there is no such sample or environment.
        """
        if self._last is None:
            raise ValueError("nothing has been planned yet: there is no rollout to look at")
        if not 0 <= e < self.envs or not (sample is None or 0 <= sample < self.shape.samples):
            raise ValueError(f"there are {self.envs} environments of {self.shape.samples} samples each, from 0 on")
        costs = self.engine.cost.numpy()[e]
        sample = int(self._last[1].best[e]) if sample is None else sample
        out = self.engine.record([(e * self.shape.samples + sample) * self.shape.domains])
        return Rollout(
            times=float(self._observed.last[e]) + self.plan_step.grid.t,
            joint_q=out.joint_q[:, 0].copy(),
            joint_qd=out.joint_qd[:, 0].copy(),
            body_q=out.body_q[:, 0].copy(),
            control=out.control[:, 0].copy(),
            knots=self.plan_step.strategy.knots.numpy()[e, sample].copy(),
            cost=float(costs[sample]),
            layout=self.layout,
        )

    def _safe_command(self, needed: np.ndarray) -> np.ndarray:
        """Zero velocity or effort, a stop by the next control, the position last seen, as the drive is; ``[n, nu]``."""
        seen, control_dt = self._observed, self.scene.timing.control_dt
        if (self.layout.control_safe >= 0).any() and not seen.seen[needed].all():
            raise ValueError("the first observation is not finite: there is no position to hold yet, send nothing")
        safe = safe_command(self.layout, seen.joint_q[needed], seen.joint_qd[needed], control_dt)
        return np.clip(safe, self._lower, self._upper).astype(np.float32)

    def _why_none(self, report: PlanReport, fallback: np.ndarray) -> str:
        e = int(np.flatnonzero(fallback)[0])
        terms = [label for label, cost in zip(self.costs.labels, report.terms[e], strict=True) if not np.isfinite(cost)]
        if ENGINES[self.engine.name].physics and report.diverged[e] >= self.shape.rollouts:
            return "the physics of every rollout diverged"
        return (
            f"no rollout has a finite cost: see the cost term {', '.join(terms)}" if terms else "every rollout diverged"
        )

    def _no_report(self) -> PlanReport:
        envs, nothing = self.envs, np.full(self.envs, np.nan)
        mean = self.plan_step.knots.numpy()
        zero = np.zeros(envs)
        return PlanReport(
            command=np.zeros((envs, self.layout.nu)),
            beta=self.plan_step.strategy.beta.numpy(),
            eta=zero,
            cost=nothing,
            best=zero,
            diverged=zero,
            overflow_halves=np.zeros((2, self.envs)),
            terms=np.full((envs, len(self.costs.labels)), np.nan),
            knots=mean,
            offset=self.plan_step.offset.numpy(),
        )

    def _warn_of_overflow(self, report: PlanReport) -> None:
        if report.overflow_halves.any() and not self._warned_of_overflow:
            bits, self._warned_of_overflow = int(np.bitwise_or.reduce(report.overflow)), True
            logger.warning(
                "%s: %s; rollouts go on without the rest, in which bodies sink into each other",
                self.scene.name,
                self.engine.overflow_message(bits),
            )

    def _describe(self, report: PlanReport, e: int, fallback: bool, plan_ms: float) -> Info:
        return Info(
            time=float(self._observed.last[e]),
            beta=float(report.beta[e]),
            eta=0.0 if fallback else float(report.eta[e]),
            cost=float("inf") if fallback else float(report.cost[e]),
            terms={label: float(value) for label, value in zip(self.costs.labels, report.terms[e], strict=True)},
            best=(e * self.shape.samples + int(report.best[e])) * self.shape.domains,
            plan_ms=plan_ms,
            stages_ms={name: 1e3 * seconds for name, seconds in self.graph.stages.items()},
            diverged_worlds=int(report.diverged[e]),
            fallback=fallback,
            **(self.plan_step.refiner.told(e) if self.plan_step.refiner else {}),
        )
