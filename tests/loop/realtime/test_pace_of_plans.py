# SPDX-License-Identifier: Apache-2.0
"""How often a planner plans that could plan more often."""

import time
from dataclasses import replace

import pytest
from small_scenes import compiled, make_scene

from warpmpc import Controller, State
from warpmpc.loop.realtime.messages import TimedObservation
from warpmpc.loop.realtime.planning import Planning


@pytest.mark.parametrize(("speed", "timeout", "period"), [(1.0, 0.09, 0.04), (0.5, 0.09, 0.08), (1.0, 0.06, 0.03)])
def test_a_quick_planner_makes_a_plan_for_every_control(speed, timeout, period):
    scene = make_scene(planner={"samples": 16, "horizon": 5}, agent={"plan_timeout": timeout}, engine={"threads": 1})
    planning = Planning(Controller(scene, device="cpu", engine="mujoco", compiled=compiled(scene)), speed=speed)
    state, began, plans = replace(State.start(planning.controller.layout), time=0.0), [], []

    def newest():
        began.append(time.monotonic())
        return TimedObservation(state, planning.controller.layout.control_lower * 0.0, -1)

    planning.run(newest, plans.append, lambda: len(plans) == 10)
    apart = (began[-1] - began[0]) / (len(began) - 1)
    assert planning.period == pytest.approx(period)
    assert period - 1e-3 < apart  # on a busy machine it may be more
