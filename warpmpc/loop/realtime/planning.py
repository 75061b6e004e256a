# SPDX-License-Identifier: Apache-2.0
"""The planning loop: the newest observation, where it leads to by the time a plan is ready, the plan from there.

Prediction of the state at which a plan is ready: one nominal world, rolled forward under what acts until then.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...engine.mujoco import MujocoSimulator
from ...physics.runtime.launch import CapturedLaunches, capturing
from ...scene.model.mujoco_model import Options
from ...scene.model.state import State
from ...scene.model.trajectory import BatchSize
from ...scene.schema_planner import Plans
from ...scene.task.observed import ObservedState
from .messages import TimedObservation, TimedPlan
from .plan_logger import PlanLogger

if TYPE_CHECKING:
    from ...planner.controller.controller import Controller
    from ...scene.model.compiled import CompiledScene
    from ...scene.model.layout import Layout
    from ...scene.schema import Scene
    from ...scene.task.task import Task

STEPS = 8
"""Steps of a prediction in one control: finer than the planner's, for latencies are no whole controls."""


class Predictor:
    """Predicts a state forward with MuJoCo.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        layout: Its layout, with the task's poses among the frames.
        task: The task, of one environment, which has the poses of movable obstacles.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene, layout: Layout, task: Task):
        control_dt = scene.timing.control_dt
        steps = compiled.substeps(None, control_dt, STEPS)
        self.dt = control_dt / steps
        """Step of a prediction [s]."""
        self._task, self._start = task, layout
        with capturing:
            self._engine = MujocoSimulator(
                compiled,
                BatchSize(1, 1, 1, 1),
                substeps=[1],
                timestep=self.dt,
                threads=1,
                options=Options.of(scene.engine),
            )
            self._observed = ObservedState.allocate(layout, task, "cpu")
        engine, out = self._engine, self._engine.trajectory
        self._clone = CapturedLaunches(partial(engine.clone, self._observed))
        self._step = [CapturedLaunches(partial(engine.rollout_part, out.control, 0))]
        # the same memory, seen by NumPy
        self._control, self._diverged = out.control.numpy()[0, 0], out.diverged.numpy()
        self._reached = [array.numpy()[1, 0] for array in (out.joint_q, out.joint_qd, out.act)]
        seen = self._observed
        self._seen = [array.numpy()[0] for array in (seen.joint_q, seen.joint_qd, seen.act, seen.mocap, seen.pose)]

    def __call__(self, state: State, control: Callable[[float, State], np.ndarray], duration: float) -> State:
        """The state after a time, rounded up to whole steps; the state itself where the physics diverges.

        Args:
            state: State of one environment, with its time.
            control: The control ``[nu]`` at a time [s] and state.
            duration: How far [s].
        """
        steps = math.ceil(duration / self.dt - 1e-6)
        if steps < 1:
            return state
        engine, diverged, now = self._engine, False, state
        with capturing:
            self._set(state)
            self._clone()
            for k in range(steps):
                self._control[:] = control(now.time, now)
                engine.run(self._step)
                engine.initial[0] = engine.state[0, -1]
                engine.initial[0, 0] = 0.0  # steps that take other than their time count as diverged
                diverged |= bool(self._diverged[0])
                q, qd, act = (array.copy() for array in self._reached)
                now = replace(state, joint_q=q, joint_qd=qd, act=act, time=state.time + (k + 1) * self.dt)
        if diverged or not all(np.isfinite(part).all() for part in (q, qd, act)):
            return state
        return now

    def _set(self, state: State) -> None:
        start = self._start
        act = start.act if state.act is None else state.act
        mocap = start.mocap if state.mocap is None else state.mocap
        pose = self._task.block[0, : 7 * len(self._task.pose_name)].reshape(-1, 7)
        for array, values in zip(self._seen, (state.joint_q, state.joint_qd, act, mocap, pose), strict=True):
            array[:] = values


REMEMBERED = 9
"""Latest latencies whose median is the one expected next."""
LONGEST_PAUSE = 0.01
"""Time between checks whether to stop [s]."""
PAUSE = 2e-4
"""Wall time between looks for a new observation [s]."""


class Planning:
    """Plans from observations that are on their way while the robot moves on.

    Args:
        controller: Makes the plans, of one environment.
        speed: The robot's seconds in a second of wall time.
        latency: Time from observation to plan to expect, on the robot's clock [s]; as it is measured if None.
        number: Number of the first plan.
        logger: Takes note of every plan.
    """

    speed: float
    """The robot's seconds in a second of wall time; may change between two plans."""
    plans: Plans
    """Number of plans, ``agent.plans``; may change likewise."""

    def __init__(
        self,
        controller: Controller,
        *,
        speed: float = 1.0,
        latency: float | None = None,
        number: int = 0,
        logger: PlanLogger | None = None,
    ):
        if controller.envs != 1:
            raise ValueError(f"plans for one robot are of one environment, not of {controller.envs}")
        self.controller, self.speed, self._given = controller, speed, latency
        scene = controller.scene
        self.plans = scene.agent.plans
        self._longest = scene.planner.horizon * scene.timing.control_dt  # farther no plan reaches
        self._predict = None
        if scene.agent.compensate:
            self._predict = Predictor(scene, controller.compiled, controller.layout, controller.task)
        self._latencies: deque[float] = deque(maxlen=REMEMBERED)
        self._timed: TimedPlan | None = None  # the newest that is followed
        self._last: TimedObservation | None = None  # what was planned from last
        self._number = number  # of the next plan
        self._due = 0.0  # when the next plan may begin, on the monotonic clock [s]
        self._turn, self._holds = threading.Lock(), 0
        self._logger = logger
        self._warm_up()

    def _warm_up(self) -> None:
        """Predict and plan twice and forget it: at first kernels are compiled, then they are recorded for later."""
        layout = self.controller.layout
        start, rest = State.start(layout), np.zeros(layout.nu, dtype=np.float32)
        for _ in range(2):
            if self._predict is not None:
                self._predict(replace(start, time=0.0), lambda *_: rest, self._predict.dt)
            self.controller.step(start)
        self.controller.reset()

    @property
    def latency(self) -> float:
        """Time that the next plan is expected to take, on the robot's clock [s]."""
        if self._given is not None:
            return self._given
        return float(np.median(self._latencies)) if self._latencies else 0.0

    def plan(self, observation: TimedObservation, *, reach: float | None = None) -> TimedPlan | None:
        """The plan from an observation; None for one that is not finite.

        Args:
            observation: The observation.
            reach: How far to predict it forward [s]; by its age and :attr:`latency` if None.
        """
        controller, state = self.controller, observation.state
        if not all(np.isfinite(part).all() for part in (state.joint_q, state.joint_qd, state.time)):
            return None
        if observation.task is not None:
            controller.task.follow(observation.task)
        begun = time.monotonic()
        if reach is None:
            age = self.speed * (begun - observation.stamp) if self._given is None else 0.0
            reach = min(age + self.latency, self._longest)
        if self._predict is not None:
            state = self._predict(state, self._acting(observation), reach)
        plan = controller.plan(state)
        ended = time.monotonic()
        latency = self.speed * (ended - observation.stamp)
        self._latencies.append(self.speed * (ended - begun))
        info = controller.info
        seen, survived = observation.state.time, not info.fallback
        timed = TimedPlan(plan, self._number, seen, latency, info.plan_ms, survived, info.eta)
        self._number += 1
        self._timed = timed if timed.survived else self._timed
        if self._logger is not None:
            self._logger.note(observation, reach, timed)  # before anybody can follow it
        return timed

    def _acting(self, observation: TimedObservation) -> Callable[[float, State], np.ndarray]:
        """Controls that the robot is sent until the plan is ready."""
        if observation.following and self._timed is not None:
            return self._timed.plan.at
        return lambda *_: observation.command

    def run(
        self,
        newest: Callable[[], TimedObservation | None],
        publish: Callable[[TimedPlan], None],
        stopped: Callable[[], bool],
    ) -> None:
        """Plan until told to stop, once in every :attr:`period`.

        With ``agent.plans = "fit"`` an observation is planned from again until there is a new one, or it is too old to
        be believed.

        Args:
            newest: The newest observation, None where there is no new one.
            publish: Takes each plan.
            stopped: Whether to stop.
        """
        self._due = time.monotonic()
        while not stopped():
            if self._holds or not self._round(newest, publish):
                time.sleep(min(max(self._due - time.monotonic(), PAUSE), LONGEST_PAUSE))

    def _round(self, newest: Callable[[], TimedObservation | None], publish: Callable[[TimedPlan], None]) -> bool:
        """Make a plan if one is due and there is something to make it from; returns whether there was."""
        with self._turn:
            if time.monotonic() < self._due:
                return False
            observation = newest()
            if observation is None and self._may_plan_again(self._last):
                observation = self._last
            if observation is None:
                return False
            self._due, self._last = max(self._due + self.period, time.monotonic()), observation
            if (timed := self.plan(observation)) is not None:
                publish(timed)
            return True

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep :meth:`run` in another thread from planning for a while; the plan being made is made first."""
        self._holds += 1
        try:
            with self._turn:
                yield
        finally:
            self._holds -= 1

    def forget(self) -> None:
        """Forget what was observed and planned before; while :meth:`held`."""
        self._last = self._timed = None

    def _may_plan_again(self, last: TimedObservation | None) -> bool:
        if last is None or self.plans is not Plans.FIT:
            return False
        believed = self.controller.scene.agent.observation_timeout
        return self.speed * (time.monotonic() - last.stamp) < believed

    @property
    def period(self) -> float:
        """Wall time from plan to plan, at least [s]: none where as many are made as fit, else a control's.

        More rounds of sampling at what is nearly the same state carry a plan into the nearest minimum: at four plans a
        control five of twelve runs of ``omni_push_box`` were held up at a corner of the box. Two plans there are in the
        time that one is followed for, whatever a control's.
        """
        scene = self.controller.scene
        if self.plans is Plans.FIT:
            return 0.0
        return min(scene.timing.control_dt, 0.5 * scene.agent.plan_timeout) / self.speed


class PlannerThread:
    """The planning loop in a thread of this process, for code that shares a controller with it.

    Robots want :class:`~warpmpc.loop.realtime.process.PlannerProcess`: threads of one process wait for each other.

    Args:
        controller: Makes the plans.
        speed: The robot's seconds in a second of wall time.
        log: Run log beside which what every plan was made from is noted, for :func:`warpmpc.replay`; nowhere if None.
        on_plan: Called in that thread after every plan, with the controller still as the plan left it.
    """

    def __init__(
        self,
        controller: Controller,
        *,
        speed: float = 1.0,
        log: str | Path | None = None,
        on_plan: Callable[[], None] = lambda: None,
    ):
        self._logger = None if log is None else PlanLogger(controller, Path(log))
        self.controller, self.planning = controller, Planning(controller, speed=speed, logger=self._logger)
        self._on_plan = on_plan
        self._stop = threading.Event()
        self._observation: TimedObservation | None = None
        self._taken: TimedObservation | None = None
        self._timed: TimedPlan | None = None
        self._failed: Exception | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def task(self) -> Task:
        """The task, shared with the controller."""
        return self.controller.task

    def __enter__(self) -> PlannerThread:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()
        if self._logger is not None:
            self._logger.close()

    def observe(self, observation: TimedObservation) -> None:
        """Hand over an observation; the one before is forgotten."""
        self._observation = observation

    def newest(self) -> TimedPlan | None:
        """The newest plan.

        Raises:
            Exception: The error that ended planning; no other plan will come.
        """
        if self._failed is not None:
            raise self._failed
        return self._timed

    def forget(self) -> None:
        """Forget observations and plans from before; while ``planning.held``."""
        self.planning.forget()
        self._observation = self._taken = self._timed = None

    def _run(self) -> None:
        try:
            self.planning.run(self._take, self._publish, self._stop.is_set)
        except Exception as error:
            self._failed = error

    def _take(self) -> TimedObservation | None:
        observation = self._observation
        if observation is self._taken:
            return None
        self._taken = observation
        return observation

    def _publish(self, timed: TimedPlan) -> None:
        self._timed = timed
        self._on_plan()
