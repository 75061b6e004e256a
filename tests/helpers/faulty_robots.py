# SPDX-License-Identifier: Apache-2.0
"""A simulated robot whose observations go wrong on demand and that notes what it was sent, and a planner like it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from warpmpc import PlannerProcess, Plant, State
from warpmpc.loop.realtime.messages import TimedObservation, TimedPlan


class FaultyRobot:
    """Passes everything on to a plant; what it shows goes through :attr:`spoil`."""

    spoil: Callable[[State], State] | None = None

    def __init__(self, plant: Plant):
        self.plant = plant
        self.sent: list[tuple[float, np.ndarray]] = []
        """Commands and the plant's own time at which each began to act [s]."""

    def observe(self) -> State:
        state = self.plant.observe()
        return self.spoil(state) if self.spoil else state

    def apply(self, control: np.ndarray) -> None:
        self.sent.append((self.plant.time, control.copy()))
        self.plant.apply(control)

    def freeze(self) -> None:
        """Show the present state for good."""
        state = self.plant.observe()
        self.spoil = lambda _: state

    def freeze_joints(self) -> None:
        """Show the present joints for good, with times that go on."""
        state = self.plant.observe()
        self.spoil = lambda now: replace(state, time=now.time)

    def go_back(self, seconds: float) -> None:
        """Show times that are earlier by some seconds."""
        self.spoil = lambda state: replace(state, time=state.time - seconds)

    def forget_numbers(self) -> None:
        """Show joint positions that are not numbers."""
        self.spoil = lambda state: replace(state, joint_q=state.joint_q * np.nan)

    def reuse_arrays(self) -> None:
        """Show what is seen in the same arrays again and again, as drivers do."""
        first = self.plant.observe()
        own = State(np.array(first.joint_q), np.array(first.joint_qd))

        def again(state: State) -> State:
            own.joint_q[:], own.joint_qd[:] = state.joint_q, state.joint_qd
            return replace(own, time=state.time)

        self.spoil = again


class FaultyPlanner:
    """Passes everything on to a planner; the plans that it hands out go through :attr:`spoil`."""

    spoil: Callable[[TimedPlan], TimedPlan] | None = None

    def __init__(self, planner: PlannerProcess):
        self.planner = planner

    def observe(self, observation: TimedObservation) -> None:
        self.planner.observe(observation)

    def newest(self) -> TimedPlan | None:
        timed = self.planner.newest()
        return self.spoil(timed) if self.spoil and timed else timed

    def exceed(self) -> None:
        """Hand out controls that are five times what is allowed."""

        def beyond(timed: TimedPlan) -> TimedPlan:
            plan = timed.plan
            return replace(timed, plan=replace(plan, knots=np.tile(5.0 * plan.upper, (len(plan.knots), 1))))

        self.spoil = beyond
