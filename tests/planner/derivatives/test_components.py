# SPDX-License-Identifier: Apache-2.0
"""What general terms are norms of: the norms of their residuals are what the terms themselves cost."""

import numpy as np
import warp as wp
from small_scenes import make_scene
from stepping import stepping

from warpmpc.engine.protocol import Proposal
from warpmpc.planner.derivatives.rollouts import Policy

LENGTHS = {"distance": 0.01, "height": 0.01, "orientation": 0.01, "tilt": 0.01, "along": 0.01, "yaw": 0.01}
"""Terms that are rounded near zero, and by how much at most."""
COST = [
    {"term": "distance", "between": ["base/centre", "away"]},
    {"term": "yaw", "of": "base/centre", "to": "away"},
    {"term": "orientation", "of": "base/centre", "to": "away"},
    {"term": "orientation", "name": "tilt", "of": "base/centre", "to": "away", "tilt": True},
    {"term": "orientation", "name": "along", "of": "base/centre", "axis": (1.0, 0.5, 0.0), "along": (0.0, 0.6, 0.8)},
    {"term": "height", "of": "base/centre", "target": 0.7},
    {"term": "control_effort"},
    {"term": "control_rate"},
    {"term": "joint_velocity"},
    {"term": "posture"},
]


def test_norms_of_residuals_are_what_the_terms_cost():
    away = {"name": "away", "position": (0.4, 0.3, 0.5), "rotation": (0.3, 0.2, 0.5, 0.8)}
    planner = {"samples": 16, "horizon": 5, "discount": 1.0, "randomize": False}
    s = stepping(make_scene(cost=COST, target=[away], planner=planner, engine={"threads": 1}))
    assert s.residuals.without == []
    control = np.random.default_rng(0).uniform(-1.0, 1.0, (1, 5, 3)).astype(np.float32).astype(float)
    start, before = s.rollouts.worlds.observed(), s.request.state.last_control.numpy().astype(float)
    gain, nominal = np.zeros((1, 5, 3, s.tangent.size)), np.ones((1, 5, s.tangent.width))
    outcome = s.rollouts(start, before, [Policy(nominal, control, 0.0 * control, gain)], np.zeros(3), 0.0)
    residual = s.differences(outcome.state[:, 0, :-1], control, before).residual[0]
    found = s.residuals.norms(residual)[0].sum(axis=0)
    strategy, engine = s.controller.plan_step.strategy, s.controller.engine
    strategy.knots.assign(np.repeat(control[:, None], 16, axis=1).astype(np.float32))
    engine.evaluate(Proposal(strategy.knots, strategy.offset, 1))
    engine.explain(wp.zeros(1, dtype=int, device="cpu"))
    for label, own, cost in zip(s.controller.costs.labels, found, engine.term_cost.numpy()[0], strict=True):
        assert cost > 0.01, label
        np.testing.assert_allclose(own, cost, rtol=1e-4, atol=5 * LENGTHS.get(label, 0.0), err_msg=label)
