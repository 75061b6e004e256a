# SPDX-License-Identifier: Apache-2.0
"""Times and discount of the steps of a horizon, and rollouts whose steps differ in length."""

import mujoco
import numpy as np
import pytest
from small_scenes import BOX, compiled, make_scene

from warpmpc import Controller, SceneError, State
from warpmpc.engine.protocol import TimeGrid


def grid(**planner) -> TimeGrid:
    return TimeGrid.of(make_scene(planner={"samples": 8, "horizon": 5, **planner}))


@pytest.mark.parametrize(
    ("dt", "expected"),
    [
        (None, [0.08] * 5),  # two controls
        ((0.1,), [0.1] * 5),
        ((0.01, 0.02, 0.02, 0.05, 0.1), [0.01, 0.02, 0.02, 0.05, 0.1]),
        ({"first": 0.02, "last": 0.1}, [0.02, 0.04, 0.06, 0.08, 0.1]),
        ({"first": 0.02, "last": 0.08, "constant": 3}, [0.02, 0.02, 0.02, 0.05, 0.08]),
        ({"first": 0.02, "last": 0.08, "constant": 9}, [0.02] * 5),
    ],
)
def test_steps_are_of_one_length_listed_or_growing(dt, expected):
    found = grid(dt=dt)
    np.testing.assert_allclose(found.dt, expected, rtol=1e-9)
    np.testing.assert_allclose(found.t, [0.0, *np.cumsum(expected)], rtol=1e-9)
    assert found.steps == 5
    assert found.even is (len(set(expected)) == 1)


@pytest.mark.parametrize(("discount", "terminal"), [(1.0, 1.0), (0.9, 1.0), (0.95, 4.0), (1.0, 0.0)])
def test_steps_count_by_the_discount_and_the_last_one_by_the_terminal_factor(discount, terminal):
    expected = discount ** np.arange(5)
    expected[-1] *= terminal
    found = grid(discount=discount, terminal=terminal)
    np.testing.assert_allclose(found.discount, expected, rtol=1e-6)
    arrays = found.arrays("cpu")
    np.testing.assert_allclose(arrays.t.numpy(), found.t, rtol=1e-6)
    np.testing.assert_allclose(arrays.dt.numpy(), found.dt, rtol=1e-6)


def test_a_list_has_one_length_for_every_step():
    with pytest.raises(ValueError, match="dt has one number, or 5"):
        grid(dt=(0.1, 0.2))


@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
@pytest.mark.parametrize("dt", [(0.04, 0.05, 0.08, 0.08, 0.08), {"first": 0.04, "last": 0.1}])
def test_physics_of_one_length_refuses_steps_that_are_no_multiple_of_it(dt, engine):
    scene = make_scene(planner={"samples": 4, "horizon": 5, "dt": dt})
    with pytest.raises(SceneError, match=r"planner\.dt.*multiple") as caught:
        Controller(scene, engine=engine, device="cpu", compiled=compiled(scene))
    assert caught.value.key == "planner.dt"


@pytest.mark.parametrize("spline", ["zero", "linear", "cubic"])
def test_a_rollout_of_uneven_steps_is_what_mujoco_does_step_by_step(spline):
    """Steps of one, one, two, three and five times the first, of two physics steps each."""
    dt = (0.04, 0.04, 0.08, 0.12, 0.2)
    scene = make_scene(
        object=[{**BOX, "position": (0.4, 0.0, 0.1)}],
        planner={"samples": 6, "horizon": 5, "dt": dt, "spline": spline, "noise": {"sigma": (1.0,)}},
        cost=[{"term": "distance", "between": ["box", "goal"]}],
    )
    controller = Controller(scene, engine="mujoco", compiled=compiled(scene))
    q, qd = controller.layout.joint_q.copy(), controller.layout.joint_qd.copy()
    qd[0] = 0.8
    for time in (0.0, 0.1):
        controller.step(State(q, qd, time))
    simulator, shape = controller.engine.simulator, controller.shape
    assert tuple(simulator.substeps) == (2, 2, 4, 6, 10)
    control, out = controller.engine.recorded.control.numpy(), simulator.trajectory
    for w in range(shape.worlds):
        model = simulator.models[w]
        data = mujoco.MjData(model)
        assert model.opt.timestep == pytest.approx(0.02)
        mujoco.mj_setState(model, data, simulator.initial[w], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        for t, count in enumerate(simulator.substeps):
            data.ctrl[:] = control[t, w]
            for _ in range(count):
                mujoco.mj_step(model, data)
            np.testing.assert_allclose(out.joint_q.numpy()[t + 1, w, :6], data.qpos[:6], atol=1e-6)
            np.testing.assert_allclose(out.joint_qd.numpy()[t + 1, w, :6], data.qvel[:6], atol=1e-5)
        assert data.time == pytest.approx(sum(dt))
    assert np.ptp(out.joint_q.numpy()[-1, :, 3]) > 0.01  # the box was pushed differently
