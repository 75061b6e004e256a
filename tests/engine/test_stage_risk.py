# SPDX-License-Identifier: Apache-2.0
"""The risk of a step's cost, whatever rolls out and judges: against float64, from what terms cost at every step."""

import numpy as np
import pytest
import warp as wp
from small_scenes import compiled, make_scene

from warpmpc import Controller, State

COST = [
    {"term": "distance", "between": ["base/centre", "goal"], "weight": 2.0},
    {"term": "control_rate", "weight": 0.05},
]
JOINTS = {
    **make_scene().robot[0].model_dump(exclude_unset=True),
    "drive": {"mode": "acceleration", "damping": 100.0, "limit": 2.0},
}


def planned(engine: str, stage_risk: float, **planner) -> Controller:
    """A controller after two plans."""
    sections = {"robot": [JOINTS]} if engine == "kinematic" else {}
    planner = {"samples": 13, "horizon": 5, "discount": 0.9, "stage_risk": stage_risk, **planner}
    scene = make_scene(cost=COST, planner=planner, engine={"threads": 1}, **sections)
    mpc = Controller(scene, engine=engine, compiled=compiled(scene))
    for _ in range(2):
        mpc.step(State.start(mpc.layout))
    return mpc


@pytest.mark.parametrize("stage_risk", [-1.5, 0.8])
@pytest.mark.parametrize("engine", ["mujoco", "fused", "kinematic"])
def test_samples_cost_the_risk_of_their_steps(engine, stage_risk):
    mpc = planned(engine, stage_risk)
    stage = mpc.engine.evaluator.cost.numpy().astype(np.float64)
    assert (stage.max(axis=(1, 2)) > 0.0).all()
    step = np.expm1(stage_risk * stage.sum(axis=0)) / stage_risk
    expected = np.einsum("tw,t->w", step, mpc.plan_step.grid.discount)
    np.testing.assert_allclose(mpc.engine.cost.numpy()[0], expected, rtol=1e-5)
    plain = np.einsum("itw,t->w", stage, mpc.plan_step.grid.discount)
    assert np.all((expected > plain) == (stage_risk > 0.0))  # averse or seeking
    mpc.engine.explain(wp.array([4], dtype=int))
    assert mpc.engine.term_cost.numpy().sum() == pytest.approx(expected[4], rel=1e-5)


@pytest.mark.parametrize("engine", ["fused", "kinematic"])
def test_without_it_engines_that_sum_on_the_way_record_nothing(engine):
    assert not planned(engine, 0.0).engine.records
    assert planned(engine, 1.0).engine.records
