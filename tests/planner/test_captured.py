# SPDX-License-Identifier: Apache-2.0
"""A plan captured in a CUDA graph is the plan launched piece by piece, for every strategy: pytest -m gpu."""

import numpy as np
import pytest
from needs import CUDA, need
from small_scenes import BOX, WALL, compiled, make_scene

from warpmpc import Controller, State

METHODS = {
    "mppi": {"method": "mppi"},
    "mppi ess": {"method": "mppi", "temperature": {"ess": 5.0}},
    "predictive_sampling": {"method": "predictive_sampling", "spline": "cubic", "knots": 3},
    "cem": {"method": "cem", "sigma_min": (0.05,)},
    "dial": {"method": "dial"},
    "tsallis": {"method": "tsallis"},
    "stage risk": {"method": "mppi", "stage_risk": -1.0, "domains": 2, "risk": "exponential"},
    "storm": {
        "method": "mppi",
        "iterations": 2,
        "step_size": 0.98,
        "covariance": {"form": "full", "step_size": 0.7, "kappa": 0.005},
        "noise": {"null_share": 0.2, "redraw": False},
        "keep_best": True,
    },
    "one sigma a control, best": {
        "method": "mppi",
        "covariance": {"form": "diagonal", "kappa": 0.005},
        "execute": "best",
    },
    "full at every knot": {"method": "mppi", "iterations": 2, "covariance": {"form": "full_knots", "kappa": 0.005}},
    "diagonal": {"method": "predictive_sampling", "covariance": {"form": "diagonal"}, "keep_best": True},
}


@pytest.mark.gpu
@pytest.mark.parametrize("envs", [1, 3])
@pytest.mark.parametrize("name", METHODS)
def test_a_captured_plan_is_the_plan_launched_piece_by_piece(name, envs):
    need(CUDA)
    scene = make_scene(
        object=[{**BOX, "position": (1.5, 0.0, 0.1)}],
        obstacle=[{**WALL, "position": (0.7, 0.0, 0.2), "size": (0.1, 0.8, 0.4)}],
        cost=[
            {"term": "distance", "between": ["base/centre", "box"], "metric": "geodesic"},
            {"term": "control_rate", "weight": 0.1},
        ],
        planner={"samples": 24, "horizon": 5, **METHODS[name]},
    )
    captured, plain = (
        Controller(scene, engine="mujoco_warp", device="cuda:0", envs=envs, compiled=compiled(scene), seed=4)
        for _ in range(2)
    )
    plain.graph.capturable = False
    layout = captured.layout
    box = int(layout.joint_q_start[layout.entity("box").joints[0]])
    q, qd = np.tile(layout.joint_q, (envs, 1)), np.tile(layout.joint_qd, (envs, 1))
    for step in range(6):
        q[:, 1] = 0.05 * step + 0.1 * np.arange(envs)
        q[:, box] += 0.08  # its fields follow
        state = State(q.copy(), qd, 0.04 * step + 0.01 * (step > 3))
        if step == 2:
            for controller in (captured, plain):
                controller.task["control_rate"] = 0.5
        np.testing.assert_allclose(captured.step(state), plain.step(state), atol=2e-4)
        infos = [np.atleast_1d(np.array(c.info, dtype=object)) for c in (captured, plain)]
        for a, b in zip(*infos, strict=True):
            assert a.cost == pytest.approx(b.cost, rel=1e-3)
            assert a.beta == pytest.approx(b.beta, rel=1e-3)
    assert captured.graph.captured is not None
    assert plain.graph.captured is None


@pytest.mark.gpu
@pytest.mark.parametrize(
    "planner", [{"method": "ilqs"}, {"method": "ilqg"}, {"refine": {"method": "gradient"}}], ids=str
)
def test_with_derivatives_the_samples_are_one_graph_and_commands_the_same(planner):
    need(CUDA)
    cost = [
        {"term": "position_residual", "of": "base/centre", "target": [1.0, 0.5], "axes": "xy"},
        {"term": "control_effort", "weight": 0.01},
    ]
    scene = make_scene(cost=cost, planner={"samples": 24, "horizon": 8, "randomize": False, **planner})
    captured, plain = (
        Controller(scene, engine="fused", device="cuda:0", compiled=compiled(scene), seed=4) for _ in range(2)
    )
    plain.plan_step._sequence = plain.plan_step.sequence()
    layout = captured.layout
    for step in range(6):
        q = layout.joint_q + np.float32([0.05 * step, 0.0, 0.0])
        state = State(q, layout.joint_qd, 0.04 * step)
        np.testing.assert_allclose(captured.step(state), plain.step(state), atol=1e-4)
    assert captured.plan_step._sequence[0][1]._graph is not None
    assert captured.graph.captured is None
