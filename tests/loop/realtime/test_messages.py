# SPDX-License-Identifier: Apache-2.0
"""What crosses between robot and planner arrives as it was sent."""

import numpy as np
import pytest
from small_scenes import layout_of, make_scene

from warpmpc import Plan
from warpmpc.loop.realtime.messages import PlanCodec, TimedPlan
from warpmpc.planner.splines import SplineKind


@pytest.mark.parametrize("kind", SplineKind)
def test_a_plan_that_crossed_has_the_controls_that_it_had(kind):
    scene = make_scene(planner={"samples": 8, "horizon": 6, "spline": kind.value})
    layout = layout_of(scene)
    times = 3.0 + 0.04 * np.arange(6)
    knots = np.random.default_rng(0).uniform(-0.9, 0.9, (6, 3)).astype(np.float32)
    plan = Plan(knots, times, kind, layout.control_lower.copy(), layout.control_upper.copy())
    codec = PlanCodec(layout, 6)
    found = codec.decode(codec.encode(TimedPlan(plan, 7, 2.97, 0.03, 12.0, True, 8.5)))
    assert (found.number, found.observed, found.latency, found.plan_ms, found.survived) == (7, 2.97, 0.03, 12.0, True)
    assert found.eta == 8.5
    for moment in 3.0 + 0.013 * np.arange(18):
        np.testing.assert_array_equal(found.plan.at(moment), plan.at(moment))
