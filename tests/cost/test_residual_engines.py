# SPDX-License-Identifier: Apache-2.0
"""Residuals inside the launches of engines: what `fused` sums is what their Warp functions say about its record."""

import mujoco
import numpy as np
import warp as wp
from evaluating import Evaluating
from fused_costs import assert_costs, expected_totals, planned
from small_scenes import chain_scene, compiled, layout_of, make_engine, observed, random_state

from warpmpc import Scene
from warpmpc.scene.model.trajectory import BatchSize

COM = {"centre_of_mass": "chain"}
COSTS = [
    {"term": "position_residual", "of": COM, "lead": 0.2, "relative_to": ["chain/hand", "chain/head"], "axes": "xy",
     "norm": {"kind": "smooth_abs", "p": 0.1}},
    {"term": "position_residual", "of": "chain/head", "relative_to": ["chain/hand", "chain/arm"], "axes": "z",
     "target": "height", "norm": {"kind": "l22", "p": 0.1, "q": 3.0}},
    {"term": "velocity_residual", "of": COM, "axes": "xy", "norm": {"kind": "cosh", "p": 0.9}, "terminal": 7.0},
    {"term": "velocity_residual", "of": {"centre_of_mass": "chain/arm"}, "relative_to": "chain/trunk",
     "target": "speed"},
    {"term": "angular_momentum_residual", "of": "chain", "norm": {"kind": "l2", "p": 0.1}},
    {"term": "momentum_residual", "of": "chain/arm", "axes": "xz"},
    {"term": "angular_velocity_residual", "of": ["chain/hand", "chain/head"], "relative_to": "chain/trunk"},
    {"term": "rotation_residual", "of": "chain/hand", "to": "chain/head", "axes": "xz"},
    {"term": "orientation", "of": "chain/hand", "axis": [1.0, 0.0, 0.5]},
    {"term": "orientation", "name": "along", "of": "chain/hand", "to": "chain/head", "axis": [0.0, 1.0, 0.0],
     "along": [0.8, 0.6, 0.0]},
    {"term": "posture_residual", "joints": ["arm_1", "hand_x"], "target": ["height", 0.2]},
    {"term": "joint_velocity_residual", "joints": ["arm_1", "hand_2"], "norm": {"kind": "power", "p": 1.5}},
    {"term": "control_residual", "norm": {"kind": "rectify", "p": 0.3}, "terminal": 0.0},
    {"term": "gait_residual", "feet": ["chain/hand", "chain/head"], "phases": [0.0, 0.5], "cadence": 9.0,
     "height": ["height", 0.5], "swing": 0.6},
]  # fmt: skip


def residual_scene(folder, costs=COSTS, **planner) -> Scene:
    """A chain that falls, with every kind of joint."""
    scene = chain_scene(folder)
    keys = scene.model_dump(exclude={"path", "variant"})
    planner = {"samples": 21, "horizon": 5, "discount": 0.9, **planner}
    keys |= {"cost": costs, "scalar": {"height": 0.3, "speed": -0.2}, "planner": planner, "engine": {"threads": 1}}
    return Scene.model_validate(keys).model_copy(update={"path": scene.path})


def test_fused_sums_what_the_warp_functions_say(tmp_path):
    scene = residual_scene(tmp_path)
    mpc = planned(scene, envs=2, compiled=compiled(scene))
    assert not mpc.engine.records
    expected = expected_totals(mpc)
    assert (np.ptp(expected, axis=1) > 1e-3).all()
    assert_costs(mpc, expected, rtol=1e-4)


def test_terminal_counts_at_the_last_step_alone(tmp_path):
    cost = {"term": "control_residual"}
    scene = residual_scene(tmp_path, [cost, {**cost, "terminal": 7.0}, {**cost, "terminal": 0.0}])
    evaluating = Evaluating(scene, BatchSize(1, 3, 1, 5), layout=layout_of(scene))
    evaluating.control.assign(np.random.default_rng(0).normal(size=evaluating.control.shape).astype(np.float32))
    plain, more, none = evaluating.cost()
    assert (plain > 0.0).all()
    np.testing.assert_array_equal(more[:-1], plain[:-1])
    np.testing.assert_array_equal(none[:-1], plain[:-1])
    np.testing.assert_allclose(more[-1], 7.0 * plain[-1], rtol=1e-6)
    assert (none[-1] == 0.0).all()


def test_centres_of_mass_and_momenta_are_mujocos(tmp_path):
    com, arm = {"centre_of_mass": "chain"}, {"centre_of_mass": "chain/arm"}
    costs = [{"term": "position_residual", "of": com}, {"term": "velocity_residual", "of": com}]
    costs += [{"term": "position_residual", "of": arm}, {"term": "angular_momentum_residual", "of": "chain"}]
    scene = residual_scene(tmp_path, costs)
    engine, layout = make_engine(scene, samples=1, horizon=1), layout_of(scene)
    states = [random_state(layout, seed) for seed in range(6)]
    evaluating = Evaluating(scene, BatchSize(6, 1, 1, 1), layout=layout)
    q, qd = (wp.array(np.array([rows]), dtype=float, device="cpu") for rows in zip(*states, strict=True))
    evaluating.stack.kinematics(q, qd, evaluating.trajectory.body_q[1:], evaluating.trajectory.body_qd[1:])
    found = evaluating.cost()[:, 0]
    for e, state in enumerate(states):
        engine.clone(observed(*state))
        data = mujoco.MjData(engine.model)
        engine.show(0, data)
        mujoco.mj_forward(engine.model, data)
        mujoco.mj_subtreeVel(engine.model, data)
        trunk, arm = (engine.model.body(name).id for name in ("chain/trunk", "chain/arm"))
        exact = [data.subtree_com[trunk], data.subtree_linvel[trunk], data.subtree_com[arm], data.subtree_angmom[trunk]]
        np.testing.assert_allclose(found[:, e], [0.5 * (x**2).sum() for x in exact], rtol=1e-3)
