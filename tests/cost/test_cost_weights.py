# SPDX-License-Identifier: Apache-2.0
"""Weight, terminal factor and discount of a term are the same in the launch, on the record and for derivatives."""

import numpy as np
import pytest
from fused_costs import assert_costs, expected_totals, planned
from small_scenes import BOX, compiled, make_scene

from warpmpc import State
from warpmpc.cost.stack import stage_weights

TERMINAL = (1.0, 5.0, 0.0)


def scene_of(factors, **planner):
    distance = {"term": "distance", "between": ["base/centre", "box"]}
    costs = [{**distance, "name": f"d{i}", "weight": 1.0 + i, "terminal": x} for i, x in enumerate(factors)]
    return make_scene(object=[BOX], cost=costs, planner={"samples": 21, "horizon": 6, "discount": 0.9, **planner})


@pytest.mark.parametrize("stage_risk", [0.0, 0.1])
def test_the_terminal_factor_counts_at_the_last_step_alone(stage_risk):
    scene = scene_of(TERMINAL, stage_risk=stage_risk, terminal=2.0)
    mpc = planned(scene, compiled=compiled(scene))
    request = mpc.engine.request
    expected = np.ones((6, 3))
    expected[-1] = TERMINAL
    np.testing.assert_array_equal(stage_weights(request.weights), [expected * [1.0, 2.0, 3.0]])
    discount = 0.9 ** np.arange(6)
    discount[-1] *= 2.0
    np.testing.assert_allclose(request.weights.discount.numpy(), discount, rtol=1e-6)
    in_launch = mpc.engine._in_launch.numpy().tolist()
    assert in_launch == ([0, 1, 2] if stage_risk == 0.0 else [])
    if stage_risk == 0.0:
        totals = expected_totals(mpc)
        assert_costs(mpc, totals)
        last = mpc.engine.total.numpy()[1] / 2.0 - mpc.engine.total.numpy()[0]
        assert (last > 0.0).all()  # what the factor adds
        rest = mpc.engine.total.numpy()[0] - mpc.engine.total.numpy()[2] / 3.0
        np.testing.assert_allclose(last, 4.0 * rest, rtol=1e-3)
    else:
        stage = mpc.engine.evaluator.cost.numpy().astype(float)
        np.testing.assert_allclose(stage[1, :-1], 2.0 * stage[0, :-1], rtol=1e-6)
        np.testing.assert_allclose(stage[1, -1], 10.0 * stage[0, -1], rtol=1e-6)
        assert (stage[2, -1] == 0.0).all()


def test_a_weight_that_the_task_changes_is_read_at_the_next_plan():
    scene = scene_of(TERMINAL)
    mpc = planned(scene, compiled=compiled(scene))
    mpc.task["d1"] = 0.0
    mpc.step(State.start(mpc.layout))
    assert (mpc.engine.total.numpy()[1] == 0.0).all()
    assert (stage_weights(mpc.engine.request.weights)[0, :, 1] == 0.0).all()
