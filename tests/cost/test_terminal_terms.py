# SPDX-License-Identifier: Apache-2.0
"""Terminal terms take the place of the last stage's cost (Bhardwaj et al. 2021, Eq. 2), against float64, everywhere."""

import numpy as np
import pytest
import warp as wp
from small_scenes import compiled, make_scene
from stepping import stepping

import warpmpc
from warpmpc import Controller, State
from warpmpc.cost.stack import term_factors
from warpmpc.planner.derivatives.rollouts import Policy

GAMMA, STEPS = 0.9, 5
COST = [
    {"term": "control_residual", "norm": "quadratic", "weight": 0.3},
    {"term": "joint_velocity_residual", "norm": "quadratic", "weight": 2.0},
    {"term": "posture_residual", "norm": "quadratic", "weight": 50.0, "when": "terminal", "terminal": 3.0},
]
"""ĉ = .3 ½|u|² + 2 ½|q̇|², q̂ = 3 · 50 · ½|q - q0|²."""
JOINTS = {
    **make_scene().robot[0].model_dump(exclude_unset=True),
    "drive": {"mode": "acceleration", "damping": 100.0, "limit": 2.0},
}


def scene_of(engine: str = "mujoco", cost=COST, **planner):
    sections = {"robot": [JOINTS]} if engine == "kinematic" else {}
    given = {
        "samples": 13,
        "horizon": STEPS,
        "dt": 0.04,
        "knots": "steps",
        "spline": "zero",
        "discount": GAMMA,
        "iterations": 1,
    }
    return make_scene(cost=cost, planner={**given, **planner}, engine={"threads": 1}, **sections)


def planned(engine: str, *, terms=(), **keys) -> Controller:
    """A controller after two plans."""
    scene = scene_of(engine, **keys)
    mpc = Controller(scene, engine=engine, compiled=compiled(scene), terms=terms)
    for _ in range(2):
        mpc.step(State.start(mpc.layout))
    return mpc


def stages(q: np.ndarray, qd: np.ndarray, u: np.ndarray, q0: np.ndarray) -> np.ndarray:
    """Stage and terminal cost in the order of COST ``[3, T, W]``, each as if it counted at every step."""
    values = 0.3 * u**2, 2.0 * qd**2, 150.0 * (q - q0) ** 2
    return np.array([0.5 * x.astype(np.float64).sum(axis=-1) for x in values])


def reference(stage: np.ndarray, stage_risk: float = 0.0) -> np.ndarray:
    """Σ_{h<H-1} γ^h ĉ_h + γ^{H-1} q̂ ``[W]``, with ρ(·; R) around each."""
    each = np.concatenate([stage[:2, :-1].sum(axis=0), stage[2:, -1]])
    each = np.expm1(stage_risk * each) / stage_risk if stage_risk else each
    return GAMMA ** np.arange(STEPS) @ each


@pytest.mark.parametrize("stage_risk", [0.0, 0.7])
@pytest.mark.parametrize("engine", ["mujoco", "fused", "kinematic"])
def test_samples_cost_stages_and_then_what_is_terminal(engine, stage_risk):
    mpc = planned(engine, stage_risk=stage_risk)
    worlds = range(mpc.shape.worlds)
    out = mpc.engine.rollouts(worlds) if engine == "kinematic" else mpc.engine.record(worlds)
    q, qd, u = (np.asarray(a.numpy() if hasattr(a, "numpy") else a) for a in (out.joint_q, out.joint_qd, out.control))
    expected = reference(stages(q[1:], qd[1:], u[-STEPS:], mpc.layout.joint_q), stage_risk)
    with np.errstate(over="ignore"):
        expected = expected.astype(np.float32)  # which holds no more than 3e38
    np.testing.assert_allclose(mpc.engine.cost.numpy()[0], expected, rtol=2e-4)
    assert mpc.info.terms.keys() == {"control_residual", "joint_velocity_residual", "posture_residual"}


def test_the_line_search_of_derivatives_counts_the_same():
    s = stepping(scene_of(randomize=False))
    control = np.random.default_rng(0).uniform(-1.0, 1.0, (1, STEPS, 3)).astype(np.float32).astype(float)
    start, before = s.rollouts.worlds.observed(), s.request.state.last_control.numpy().astype(float)
    gain, nominal = np.zeros((1, STEPS, 3, s.tangent.size)), np.ones((1, STEPS, s.tangent.width))
    outcome = s.rollouts(start, before, [Policy(nominal, control, 0.0 * control, gain)], np.zeros(3), 0.0)
    state, nq = outcome.state[0, 0, 1:], len(s.controller.layout.joint_q)
    stage = stages(state[:, None, :nq], state[:, None, nq:], control[0, :, None], s.controller.layout.joint_q)
    np.testing.assert_allclose(outcome.cost[0, 0], reference(stage)[0], rtol=1e-5)


@wp.struct
class LateParams:
    late: float


@warpmpc.cost_term("only_late")
def only_late(s: warpmpc.StepView, p: LateParams) -> float:
    return wp.where(s.step_end[s.t] < p.late, wp.nan, 1.0)


@pytest.mark.parametrize("engine", ["mujoco", "fused"])
def test_a_terminal_term_is_not_asked_before(engine):
    cost = [{"term": "only_late", "late": 0.05, "when": "terminal", "weight": 7.0}, COST[1]]
    mpc = planned(engine, cost=cost, terms=[only_late], discount=1.0)
    np.testing.assert_allclose(mpc.engine.total.numpy()[0], 7.0, rtol=1e-6)


def test_a_terminal_term_that_is_switched_off_replaces_nothing():
    off = [*COST[:2], {**COST[2], "weight": 0.0}]
    np.testing.assert_array_equal(term_factors(scene_of(cost=COST).cost)[:2, 1], 0.0)
    np.testing.assert_array_equal(term_factors(scene_of(cost=off).cost)[:2, 1], 1.0)
