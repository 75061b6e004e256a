# SPDX-License-Identifier: Apache-2.0
"""Others on the same poses: a geometric planner whose path is then driven, and differential inverse kinematics.

Both drive the same plant by the same accelerations. They know the arm as MuJoCo does, with all links solid.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .reference import quickest

if TYPE_CHECKING:
    from warpmpc import State

    from .arm import Arm
    from .poses import Reachable

SPACE = 0.01
"""Room that planned postures leave around the links [m]."""
SECONDS = 2.0
"""Time the geometric planner is given [s]."""
TRIES = 20
"""Random starts of the inverse kinematics."""
STIFFNESS, DAMPING = 100.0, 20.0
"""Of the law that follows a way: acceleration = feed-forward + 100 (q - q) + 20 (q̇ - q̇)."""


class PlanAndExecute:
    """RRT-Connect to a posture at the pose, shortened, timed piece by piece by ruckig, then followed.

    The arm stops at every corner that is left of the path: what ruckig does between two states needs no waypoints.

    Args:
        arm: The arm.
        acceleration: Greatest acceleration [rad/s²].
        dt: Length of a control [s].
    """

    def __init__(self, arm: Arm, acceleration: float, dt: float):
        self.arm, self.acceleration, self.dt = arm, acceleration, dt

    def begin(self, target: Reachable, *, seed: int) -> None:
        """Plan the whole way."""
        arm, start = self.arm, self.arm.start[self.arm.dofs]
        goals = arm.postures(target.pose, TRIES, seed=seed, margin=SPACE)
        goals.sort(key=lambda q: float(np.abs((q - start) / arm.speed).max()))
        path = plan_joints(arm, start, goals, seed=seed) if goals else None
        ends = itertools.pairwise(path or [])
        ways = [quickest(arm, self.acceleration, first, second, dt=self.dt) for first, second in ends]
        self._q = np.concatenate([start[None], *(way.q for way in ways)])
        self._qd = np.concatenate([0.0 * start[None], *(way.qd for way in ways)])
        self._at = 0

    def step(self, state: State) -> np.ndarray:
        """Follow the way."""
        q, qd = (a[self.arm.dofs].astype(float) for a in (state.joint_q, state.joint_qd))
        now, after = min(self._at, len(self._q) - 1), min(self._at + 1, len(self._q) - 1)
        self._at += 1
        forward = (self._qd[after] - self._qd[now]) / self.dt
        u = forward + STIFFNESS * (self._q[now] - q) + DAMPING * (self._qd[now] - qd)
        return np.clip(u, -self.acceleration, self.acceleration)


def plan_joints(arm: Arm, start: np.ndarray, goals: list[np.ndarray], *, seed: int) -> list[np.ndarray] | None:
    """Corners of a free path to the nearest of some postures, None when none was found in time.

    Raises:
        ValueError: If OMPL is not installed.
    """
    try:
        from ompl import base, geometric, util
    except ImportError:
        raise ValueError("plan-and-execute needs OMPL: pip install ompl") from None
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(seed + 1)
    count = len(start)
    space = base.RealVectorStateSpace(count)
    bounds = base.RealVectorBounds(count)
    for i in range(count):
        bounds.setLow(i, float(arm.lower[i]))
        bounds.setHigh(i, float(arm.upper[i]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(
        lambda state: not arm.touching(np.array([state[i] for i in range(count)]), margin=SPACE)
    )
    setup.getSpaceInformation().setStateValidityCheckingResolution(0.05 / space.getMaximumExtent())
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    for goal in goals[:3]:
        setup.clear()
        ends = []
        for posture in (start, goal):
            state = space.allocState()
            for i in range(count):
                state[i] = float(posture[i])
            ends.append(state)
        setup.setStartAndGoalStates(*ends)
        setup.solve(SECONDS)
        if setup.haveExactSolutionPath():
            path = setup.getSolutionPath()
            setup.getPathSimplifier().simplifyMax(path)
            return [np.array([state[i] for i in range(count)]) for state in path.getStates()]
    return None


class DifferentialIk:
    """Joint velocities towards the pose by mink's quadratic programs, with limits and, if wanted, collisions kept off.

    Args:
        arm: The arm.
        acceleration: Greatest acceleration [rad/s²].
        dt: Length of a control [s].

    Raises:
        ValueError: If mink is not installed.
    """

    def __init__(self, arm: Arm, acceleration: float, dt: float):
        try:
            import mink
        except ImportError:
            raise ValueError("differential inverse kinematics needs mink: pip install mink daqp") from None
        self.mink, self.arm, self.acceleration, self.dt = mink, arm, acceleration, dt
        self._configuration = mink.Configuration(arm.model)
        self._task = mink.FrameTask(arm.tool_body, "body", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-3)
        joints = [mujoco.mj_id2name(arm.model, mujoco.mjtObj.mjOBJ_JOINT, int(i)) for i in arm.dofs]
        speeds = dict(zip(joints, arm.speed, strict=True))
        self._posture = mink.PostureTask(arm.model, cost=1e-3)
        self._limits = [mink.ConfigurationLimit(arm.model), mink.VelocityLimit(arm.model, speeds), *self._collisions()]

    def _collisions(self) -> list:
        """Links kept off obstacles and each other."""
        arm, model = self.arm, self.arm.model
        pairs = [([a], [b]) for a, b in arm.pairs()]
        return [
            self.mink.CollisionAvoidanceLimit(
                model, pairs, minimum_distance_from_collisions=0.005, collision_detection_distance=0.1
            )
        ]

    def begin(self, target: Reachable, *, seed: int) -> None:
        """Take a new pose."""
        x, y, z, w = target.pose[3:]
        self._task.set_target(self.mink.SE3(np.array([w, x, y, z, *target.pose[:3]])))
        self._posture.set_target(self.arm.start)

    def step(self, state: State) -> np.ndarray:
        """Accelerate to the velocities that the program finds, and no faster than can be stopped on the way left."""
        arm = self.arm
        q = arm.start.copy()
        q[arm.dofs] = state.joint_q[arm.dofs]
        self._configuration.update(q)
        try:
            # gains of the tasks are shares of the error in one step of this length
            wanted = self.mink.solve_ik(
                self._configuration, [self._task, self._posture], 0.15, solver="daqp", damping=1e-6, limits=self._limits
            )[arm.dofs]
        except self.mink.NoSolutionFound:
            wanted = np.zeros(len(arm.dofs))
        if not np.isfinite(wanted).all():
            wanted = np.zeros(len(arm.dofs))
        scale = max(1.0, float(np.abs(wanted / arm.speed).max()))
        u = (wanted / scale - state.joint_qd[arm.dofs]) / (2.0 * self.dt)
        return u / max(1.0, float(np.abs(u).max()) / self.acceleration) if math.isfinite(u.sum()) else np.zeros(len(u))
