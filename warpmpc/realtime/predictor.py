# SPDX-License-Identifier: Apache-2.0
"""Prediction of the state at which a plan is ready: one nominal world, rolled forward under what acts until then."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ..engine.mujoco import MujocoSimulator
from ..launch import Replay, capturing
from ..model.batch_size import BatchSize
from ..model.mujoco_model import Options
from ..task.observed import ObservedState

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..model.layout import Layout
    from ..model.state import State
    from ..scene.schema import Scene
    from ..task.task import Task

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
        self._clone = Replay(partial(engine.clone, self._observed))
        self._step = [Replay(partial(engine.rollout_part, out.control, 0))]
        # the same memory, seen by NumPy
        self._control, self._diverged = out.control.numpy()[0, 0], out.diverged.numpy()
        self._reached = [array.numpy()[1, 0] for array in (out.joint_q, out.joint_qd, out.act)]
        seen = self._observed
        self._seen = [array.numpy()[0] for array in (seen.joint_q, seen.joint_qd, seen.act, seen.mocap, seen.pose)]

    def __call__(self, state: State, control: Callable[[float], np.ndarray], duration: float) -> State:
        """The state after a time, rounded up to whole steps; the state itself where the physics diverges.

        Args:
            state: State of one environment, with its time.
            control: The control ``[nu]`` at a time [s].
            duration: How far [s].
        """
        steps = math.ceil(duration / self.dt - 1e-6)
        if steps < 1:
            return state
        engine, diverged = self._engine, False
        with capturing:
            self._set(state)
            self._clone()
            for k in range(steps):
                self._control[:] = control(state.time + k * self.dt)
                engine.run(self._step)
                engine.initial[0] = engine.state[0, -1]
                engine.initial[0, 0] = 0.0  # steps that take other than their time count as diverged
                diverged |= bool(self._diverged[0])
        if diverged:
            return state
        q, qd, act = (array.copy() for array in self._reached)
        if not all(np.isfinite(part).all() for part in (q, qd, act)):
            return state
        return replace(state, joint_q=q, joint_qd=qd, act=act, time=state.time + steps * self.dt)

    def _set(self, state: State) -> None:
        start = self._start
        act = start.act if state.act is None else state.act
        mocap = start.mocap if state.mocap is None else state.mocap
        pose = self._task.block[0, : 7 * len(self._task.pose_name)].reshape(-1, 7)
        for array, values in zip(self._seen, (state.joint_q, state.joint_qd, act, mocap, pose), strict=True):
            array[:] = values
