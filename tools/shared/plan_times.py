# SPDX-License-Identifier: Apache-2.0
"""Times of plans and of the physics alone that they cannot do without, for the tools that compare engines."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import mujoco
import mujoco.rollout
import numpy as np
import warp as wp

import warpmpc

WARM_UP = 3
"""Plans before those that count."""


def batched(states: Sequence[warpmpc.State], envs: int) -> list[warpmpc.State]:
    """Observations of several environments, each of which is somewhere else in the run the states are from."""
    if envs == 1:
        return list(states)
    out = []
    for i, state in enumerate(states):
        many = [states[(i + e) % len(states)] for e in range(envs)]
        q, qd = np.stack([s.joint_q for s in many]), np.stack([s.joint_qd for s in many])
        out.append(warpmpc.State(q, qd, state.time))
    return out


class BareRollout:
    """The floor: one call of ``mujoco.rollout`` with an engine's own models and inputs, and nothing else.

    Args:
        engine: The simulator of the engine ``mujoco``.
    """

    def __init__(self, engine):
        self.engine = engine
        self.pool = mujoco.rollout.Rollout(nthread=engine.threads)
        self.data = [mujoco.MjData(engine.model) for _ in range(engine.threads)]
        self.state, self.sensor = np.empty_like(engine.state), np.empty_like(engine.sensor)

    def __call__(self) -> float:
        """Roll the engine's last inputs out again; returns the wall time [s]."""
        engine = self.engine
        start = time.perf_counter()
        self.pool.rollout(
            engine.models,
            self.data,
            engine.initial,
            engine.control,
            nstep=engine.steps,
            state=self.state,
            sensordata=self.sensor,
            skip_checks=True,
            control_spec=engine._control_spec,
        )
        return time.perf_counter() - start


class BareGraph:
    """The floor of the engines ``mujoco_warp`` and ``newton``: the same solver steps captured alone.

    Args:
        engine: Its simulator.
    """

    def __init__(self, engine):
        self.device = wp.get_device(engine.device)
        if self.device.is_cuda:
            with wp.ScopedCapture(device=self.device) as capture:
                engine.step_physics()
            self._run = lambda: wp.capture_launch(capture.graph)
        else:
            self._run = engine.step_physics

    def __call__(self) -> float:
        """Step the engine's last rollouts again; returns the wall time [s]."""
        start = time.perf_counter()
        self._run()
        wp.synchronize_device(self.device)
        return time.perf_counter() - start


def bare_physics(controller: warpmpc.Controller) -> Callable[[], float] | None:
    """The physics of a controller's last plan alone, None where an engine has no other program to compare with."""
    match controller.engine.name:
        case "mujoco":
            return BareRollout(controller.engine.simulator)
        case "mujoco_warp" | "newton":
            return BareGraph(controller.engine.simulator)
    return None


def time_plans(
    controller: warpmpc.Controller,
    states: Sequence[warpmpc.State],
    *,
    plans: int,
    seconds: float = float("inf"),
    bare: Callable[[], float] | None = None,
) -> tuple[list[float], list[float]]:
    """Wall times of plans from given states in turn, from observation to command, and of the physics after each [ms].

    Args:
        controller: The controller.
        states: Observations.
        plans: Plans that count.
        seconds: Fewer of them, but five at least, where they take longer together.
        bare: What runs the physics alone.
    """
    plan, floor, begin = [], [], time.perf_counter()
    for i in range(plans + WARM_UP):
        start = time.perf_counter()
        controller.step(states[i % len(states)])
        took = time.perf_counter() - start
        if i < WARM_UP:
            begin = time.perf_counter()
            continue
        plan.append(1e3 * took)
        if bare is not None:
            floor.append(1e3 * bare())
        if len(plan) >= 5 and time.perf_counter() - begin > seconds:
            break
    return plan, floor
