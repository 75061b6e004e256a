# SPDX-License-Identifier: Apache-2.0
"""Derivatives by differences in parallel worlds, against MuJoCo's own, float64 kinematics and each other."""

import mujoco
import numpy as np
import pytest
from native_robots import installed, native_scene
from stepping import stepping

from warpmpc import Controller, SceneError, array_cost, load_scene
from warpmpc.planner.derivatives.rollouts import Policy
from warpmpc.scene.overrides import with_values

SIZES = {
    **{"planner.horizon": 4, "planner.knots": 4, "planner.dt": 0.01, "planner.samples": 16},
    **{"engine.substeps": 1, "engine.threads": 1},
}
LIFTED = 1.0  # [m] above the ground: mjd_transitionFD and these have different step sizes, and contacts bend


def scene_of(name: str):
    if name == "hand":
        path = installed("gymnasium_robotics", "envs/assets/hand/reach.xml")
        return with_values(native_scene(path), SIZES)
    return with_values(load_scene(name), SIZES)


def wild_rollout(s, seed: int = 0):
    """States [1, T, nx] and controls [1, T, nu] of a rollout from a disturbed start, off the ground."""
    rng, layout, tangent = np.random.default_rng(seed), s.controller.layout, s.tangent
    start = s.rollouts.worlds.observed()
    if s.model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        start[:, 2] += LIFTED
    start = tangent.add(start, 0.05 * rng.standard_normal(tangent.size))
    share = rng.uniform(0.35, 0.65, (1, 4, layout.nu))
    control = layout.control_lower + share * (layout.control_upper - layout.control_lower)
    return start, control.astype(np.float32).astype(float)


def rolled(s, start, control):
    """States before each control."""
    envs, steps, nu = control.shape
    gain = np.zeros((envs, steps, nu, s.tangent.size))
    states = np.ones((envs, steps, s.tangent.width))
    out = s.rollouts(start, control[:, 0], [Policy(states, control, np.zeros_like(control), gain)], np.zeros(3))
    return out.state[:, 0, :-1]


def mujocos_own(s, state, control):
    """A and B of one step by mjd_transitionFD [n, n] and [n, nu]."""
    m, n = s.model, s.tangent.size
    d = mujoco.MjData(m)
    mujoco.mj_setState(m, d, np.concatenate([[0.0], state]), mujoco.mjtState.mjSTATE_FULLPHYSICS)
    d.ctrl[:], matrix = s.ctrl(control)
    a, b = np.zeros((n, n)), np.zeros((n, m.nu))
    mujoco.mjd_transitionFD(m, d, 1e-6, True, a, b, None, None)
    return a, b @ matrix


@pytest.mark.parametrize("name", ["cartpole_swingup", "panda_reach", "humanoid_stand", "quadruped_walk", "hand"])
def test_derivatives_are_mujocos_own_where_nothing_touches(name):
    s = stepping(scene_of(name))
    s.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    start, control = wild_rollout(s)
    states = rolled(s, start, control)
    linear = s.differences(states, control, control[:, 0])
    for t in range(4):
        a, b = mujocos_own(s, states[0, t], control[0, t])
        np.testing.assert_allclose(linear.a[0, t], a, atol=1e-6 * max(1.0, np.abs(a).max()))
        np.testing.assert_allclose(linear.b[0, t], b, atol=1e-6 * max(1.0, np.abs(b).max()))


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        *((name, "fused") for name in ("cartpole_swingup", "panda_reach", "humanoid_stand")),
        *((name, "mujoco_warp") for name in ("cartpole_swingup", "humanoid_stand")),
    ],
)
def test_other_worlds_have_the_same_derivatives_in_single_precision(name, engine):
    exact, single = stepping(scene_of(name)), stepping(scene_of(name), engine)
    start, control = wild_rollout(exact)
    states = rolled(exact, start, control)
    one, other = (s.differences(states, control, control[:, 0]) for s in (exact, single))
    for found, wanted in ((other.a, one.a), (other.b, one.b), (other.c, one.c), (other.d, one.d)):
        # numbers near 10, such as velocities are, are 1e-6 apart, and steps are 1e-4
        np.testing.assert_allclose(found, wanted, atol=2e-2 * max(1.0, np.abs(wanted).max()))


def test_derivatives_without_physics_are_those_of_the_integration():
    """Joint accelerations: v' = v + u dt, q' = q + v' dt."""
    s = stepping(with_values(load_scene("storm_reach"), {**SIZES, "planner.samples": 64}), "kinematic")
    start, control = wild_rollout(s)
    states = rolled(s, start, control)
    linear = s.differences(states, control, control[:, 0])
    dt, nv = float(s.request.grid.dt[0]), s.tangent.nv
    driven = np.zeros((nv, s.controller.layout.nu))
    driven[s.controller.layout.actuator_dof] = s.controller.layout.actuator_matrix
    coasts = np.diag((driven != 0.0).any(axis=1).astype(float))  # what is not driven stands still
    a = np.block([[np.eye(nv), dt * coasts], [np.zeros((nv, nv)), coasts]])
    b = np.concatenate([dt**2 * driven, dt * driven])
    for t in range(4):  # the activations that MuJoCo would have for these drives take no part
        np.testing.assert_allclose(linear.a[0, t, : 2 * nv, : 2 * nv], a, atol=2e-3)
        np.testing.assert_allclose(linear.b[0, t, : 2 * nv], b, atol=2e-4)
    assert np.abs(linear.c).max() > 1.0


def test_residuals_follow_the_kinematics_in_double_precision():
    scene = with_values(
        load_scene("cartpole_swingup"),
        {**SIZES, "cost": [{"term": "position_residual", "of": "cart/tip", "target": [0.3, 0.0, 0.1]}]},
    )
    s = stepping(scene)
    start, control = wild_rollout(s)
    states = rolled(s, start, control)
    linear = s.differences(states, control, control[:, 0])
    m, d = s.model, mujoco.MjData(s.model)
    layout = s.controller.layout
    frame = layout.frame_name.index("cart/tip")
    body, at = int(layout.frame_body[frame]), layout.frame_pose[frame, :3].astype(float)
    name = s.controller.compiled.body_name[body]
    jac = np.zeros((3, m.nv))
    for t in range(4):
        a, _ = mujocos_own(s, states[0, t], control[0, t])
        mujoco.mj_setState(m, d, np.concatenate([[0.0], states[0, t]]), mujoco.mjtState.mjSTATE_FULLPHYSICS)
        d.ctrl[:] = s.ctrl(control[0, t])[0]
        mujoco.mj_step(m, d)
        mujoco.mj_forward(m, d)
        point = d.body(name).xpos + d.body(name).xmat.reshape(3, 3) @ at
        mujoco.mj_jac(m, d, jac, None, point, m.body(name).id)
        np.testing.assert_allclose(linear.residual[0, t], point - [0.3, 0.0, 0.1], atol=1e-5)
        np.testing.assert_allclose(linear.c[0, t], jac @ a[: m.nv], atol=2e-2)


def test_a_control_at_its_limit_is_moved_inwards_alone():
    s = stepping(scene_of("cartpole_swingup"))
    start, control = wild_rollout(s)
    states = rolled(s, start, control)
    inside = s.differences(states, control, control[:, 0])
    control[:] = s.controller.layout.control_upper
    at_limit = s.differences(states, control, control[:, 0])
    np.testing.assert_allclose(at_limit.b, inside.b, rtol=1e-3)


@pytest.mark.parametrize("engine", ["mujoco", "fused"])
def test_physics_that_fails_has_no_derivatives(engine):
    s = stepping(scene_of("cartpole_swingup"), engine)
    start, control = wild_rollout(s)
    states = rolled(s, start, control)
    s.differences(states, control, control[:, 0])
    states[0, 2, s.tangent.nq] = 1e30
    with pytest.raises(FloatingPointError, match="perturbed step failed"):
        s.differences(states, control, control[:, 0])


def test_environments_have_their_own_derivatives():
    one, two = stepping(scene_of("cartpole_swingup")), stepping(scene_of("cartpole_swingup"), envs=2)
    start, control = wild_rollout(one)
    other = wild_rollout(one, seed=1)
    states = [rolled(one, *pair) for pair in ((start, control), other)]
    both = two.differences(np.concatenate(states), np.concatenate([control, other[1]]), np.zeros((2, 1)))
    for e, (state, u) in enumerate(zip(states, (control, other[1]), strict=True)):
        alone = one.differences(state, u, np.zeros((1, 1)))
        np.testing.assert_array_equal(both.a[e], alone.a[0])
        np.testing.assert_array_equal(both.c[e], alone.c[0])


def test_a_term_over_whole_arrays_has_no_single_step():
    @array_cost("whole")
    def whole(batch):
        return batch["joint_q"][1:, :, 0]

    scene = with_values(scene_of("cartpole_swingup"), {"cost": [{"term": "whole"}], "planner.method": "ilqg"})
    with pytest.raises(SceneError, match=r"cost\.whole: .*one by one.*whole arrays"):
        Controller(scene, device="cpu", engine="mujoco", terms=[whole])
