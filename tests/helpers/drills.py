# SPDX-License-Identifier: Apache-2.0
"""Fault drills without wall time: a robot in motion whose planner is a few lines."""

import numpy as np
from faulty_robots import FaultyRobot
from small_scenes import compiled, layout_of, make_scene

from warpmpc import Plan, RobotLoop, simulated_robot
from warpmpc.loop.realtime.agent import Agent
from warpmpc.loop.realtime.messages import TimedPlan
from warpmpc.scene.schema import SplineKind

MOVE = np.array([0.5, 0.2, 0.0], dtype=np.float32)


class Scripted:
    """A planner that drives along for ever, until it is told otherwise."""

    def __init__(self, control: np.ndarray = MOVE, period: float = 0.04):
        self.control, self.period, self.survived = np.asarray(control, dtype=np.float32), period, True
        self.stalled, self.spoil = False, None  # what changes plans on the way to the agent
        self._timed, self.observations = None, []

    def observe(self, observation) -> None:
        self.observations.append(observation)
        last = -np.inf if self._timed is None else self._timed.observed
        if not self.stalled and abs(observation.state.time - last) >= self.period - 1e-9:
            nu = len(self.control)
            times = observation.state.time + np.array([0.0, 1.0])
            plan = Plan(np.tile(self.control, (2, 1)), times, SplineKind.ZERO, np.full(nu, -9.0), np.full(nu, 9.0))
            number = 0 if self._timed is None else self._timed.number + 1
            self._timed = TimedPlan(plan, number, observation.state.time, 0.0, 0.0, self.survived)

    def newest(self):
        return self.spoil(self._timed) if self.spoil and self._timed else self._timed


def drill(**sections):
    """A robot loop of a disc, its robot and its planner, driving."""
    scene = make_scene(plant={"randomize": False}, **sections)
    robot = FaultyRobot(simulated_robot(scene, compiled=compiled(scene)))
    planner = Scripted()
    loop = RobotLoop(scene, robot, planner, simulated=True, agent=Agent(scene, layout_of(scene)))
    ticks(loop, 50)
    assert loop.agent.following
    return loop, robot, planner


def ticks(loop: RobotLoop, count: int) -> None:
    """Tick without waiting."""
    for _ in range(count):
        loop.tick()
        loop.pace._tick += 1  # the next tick, without waiting for it
