# SPDX-License-Identifier: Apache-2.0
"""Cost terms that users write: functions of a step, functions of whole batches, and mistakes in both."""

import numpy as np
import pytest
import warp as wp
from evaluating import Evaluating
from needs import CUDA, need
from rollouts import Rollouts
from scipy.spatial.transform import Rotation
from small_scenes import make_scene

import warpmpc
from warpmpc import SceneError
from warpmpc.scene.model.trajectory import BatchSize


@wp.struct
class ReachParams:
    frame: int
    gain: float
    target: wp.vec3
    joint: int


@warpmpc.cost_term("reach")
def reach(s: warpmpc.StepView, p: ReachParams) -> float:
    away = wp.length_sq(warpmpc.frame_position(s, p.frame) - p.target)
    return p.gain * away + warpmpc.joint_velocity(s, 0) * warpmpc.control(s, 1) + warpmpc.joint_position(s, p.joint)


@warpmpc.array_cost("reach_array")
def reach_array(batch) -> np.ndarray:
    p = batch["params"]
    body_q = batch["body_q"][1:, :, p["body"]].astype(np.float64)
    turn = Rotation.from_quat(body_q[..., 3:].reshape(-1, 4))
    tip = body_q[..., :3] + turn.apply([0.2, 0.0, 0.0]).reshape(*body_q.shape[:2], 3)
    away = ((tip - p["target"]) ** 2).sum(-1)
    return p["gain"] * away + batch["joint_qd"][1:, :, 0] * batch["control"][..., 1] + batch["joint_q"][1:, :, 2]


KEYS = {"frame": "base/tip", "gain": 1.5, "target": [0.3, -0.2, 0.7], "joint": "yaw"}


def test_a_users_term_and_its_array_twin_agree():
    layout = Rollouts({"term": "control_effort"}).layout
    body = int(layout.frame_body[layout.frame("base/tip")])
    twin = {"term": "reach_array", "weight": 3.0, "body": body, "gain": 1.5, "target": [0.3, -0.2, 0.7]}
    for seed in range(2):
        rollouts = Rollouts({"term": "reach", "weight": 3.0, **KEYS}, twin, seed=seed, terms=[reach, reach_array])
        own, array = rollouts.cost(0), rollouts.cost(1)
        assert np.ptp(own) > 1.0
        np.testing.assert_allclose(own, array, rtol=1e-4, atol=1e-4)


def test_terms_of_the_same_function_name_are_not_mixed_up():
    def make(name: str, factor: float):
        @wp.struct
        class Params:
            offset: float

        @warpmpc.cost_term(name)
        def term(s: warpmpc.StepView, p: Params) -> float:
            return wp.static(factor) * warpmpc.joint_position(s, 0) + p.offset

        return term

    def other():
        @wp.struct
        class Params:
            offset: float

        @warpmpc.cost_term("third")
        def term(s: warpmpc.StepView, p: Params) -> float:
            return warpmpc.joint_position(s, 1) - p.offset

        return term

    terms = [make("first", 1.0), make("second", -2.0), other()]
    costs = [{"term": term.name, "offset": 0.5} for term in terms]
    rollouts = Rollouts(*costs, terms=terms)
    q = rollouts.trajectory.joint_q.numpy()[1:]
    for i, expected in enumerate((q[..., 0] + 0.5, -2.0 * q[..., 0] + 0.5, q[..., 1] - 0.5)):
        np.testing.assert_allclose(rollouts.cost(i), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame": "base/tpi"}, r"cost\.reach\.frame.*Did you mean 'base/tip'"),
        ({"joint": "yow"}, r"cost\.reach\.joint"),
        ({"gian": 1.0}, r"cost\.reach\.gian.*Did you mean 'gain'"),
        ({"wieght": 1.0}, r"unknown key.*gain.*Did you mean 'weight'"),
        ({"gain": True}, "needs finite numbers"),
        ({"gain": {"p": 1.0}}, "needs finite numbers"),
        ({"target": ["a", "b", "c"]}, "needs finite numbers"),
        ({"target": [1.0, 2.0]}, "does not fit"),
        ({"target": [1.0, 2.0, 3.0, 4.0]}, "does not fit"),
        ({"gain": [1.0, 2.0]}, "does not fit"),
    ],
)
def test_mistakes_in_a_users_table_name_the_key(change, message):
    with pytest.raises(SceneError, match=message):
        Rollouts({"term": "reach", **KEYS, **change}, terms=[reach])


def read_by_name(data):
    return data["weights"]


def test_a_key_of_every_cost_that_is_misspelt_is_refused_by_an_array_cost_too():
    keys = {"body": 0, "gain": 1.5, "target": [0.3, -0.2, 0.7], "free": 1.0}
    assert Rollouts({"term": "reach_array", **keys}, terms=[reach_array])
    with pytest.raises(SceneError, match=r"cost\.reach_array\.wieght: unknown key.*Did you mean 'weight'"):
        Rollouts({"term": "reach_array", **keys, "wieght": 3.0}, terms=[reach_array])
    helped = warpmpc.array_cost("helped")(lambda data: read_by_name(data))
    assert helped.bind({"weights": 1.0}, None) == {"weights": 1.0}


@pytest.mark.parametrize("missing", KEYS)
def test_every_field_of_a_users_struct_must_be_given(missing):
    keys = {key: value for key, value in KEYS.items() if key != missing}
    with pytest.raises(SceneError, match=f"needs the key '{missing}'"):
        Rollouts({"term": "reach", **keys}, terms=[reach])


def test_a_term_without_its_annotations_is_refused_when_it_is_defined():
    def bare(s, p):
        return 0.0

    def no_struct(s: warpmpc.StepView, p: float) -> float:
        return 0.0

    def no_view(s: ReachParams, p: ReachParams) -> float:
        return 0.0

    for function in (bare, no_struct, no_view):
        with pytest.raises(TypeError, match=rf"cost term 'x': write def {function.__name__}\("):
            warpmpc.cost_term("x")(function)


def test_an_array_cost_of_the_wrong_shape_is_refused():
    flat = warpmpc.array_cost("flat")(lambda batch: np.zeros(3))
    with pytest.raises(SceneError, match=r"cost\.flat: .*wrong shape, \(3,\) in place of \[T, W\]"):
        Rollouts({"term": "flat"}, terms=[flat]).cost()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def test_an_array_cost_is_weighed_by_environment_and_step_and_without_weight_it_is_off(device):
    if device != "cpu":
        need(CUDA)

    def counting(batch):
        steps, worlds = batch["control"].shape[:2]
        value = np.arange(steps * worlds, dtype=np.float32).reshape(steps, worlds)
        if steps == 3:  # no trial
            value[1, :4] = np.nan
        return value if device == "cpu" else wp.array(value, dtype=float, device=device)

    scene = make_scene(cost=[{"term": "counting", "terminal": 3.0}], planner={"samples": 4, "horizon": 3})
    evaluating = Evaluating(
        scene, BatchSize(2, 4, 1, 3), terms=[warpmpc.array_cost("counting")(counting)], device=device
    )
    evaluating.state.weight.assign(np.array([[0.0], [2.0]], np.float32))
    expected = 2.0 * np.arange(24.0).reshape(3, 8)
    expected[2] *= 3.0
    expected[:, :4] = 0.0
    np.testing.assert_allclose(evaluating.cost()[0], expected)


@wp.struct
class ClockParams:
    frame: int
    scalar_speed: int


@warpmpc.cost_term("clock")
def clock(s: warpmpc.StepView, p: ClockParams) -> float:
    turning = warpmpc.frame_angular_velocity(s, p.frame)[2]
    return warpmpc.step_time(s) + 10.0 * warpmpc.step_length(s) + turning * warpmpc.task_scalar(s, p.scalar_speed)


def test_a_users_term_knows_the_time_the_step_and_the_tasks_scalars():
    scene = make_scene(
        scalar={"height": 7.0, "speed": 3.0},
        cost=[{"term": "clock", "frame": "base/tip", "scalar_speed": "speed"}],
        planner={"samples": 4, "horizon": 3, "dt": (0.04, 0.04, 0.12)},
    )
    evaluating = Evaluating(scene, BatchSize(2, 4, 1, 3), terms=[clock])
    twist = np.random.default_rng(0).normal(size=evaluating.trajectory.body_qd.numpy().shape).astype(np.float32)
    evaluating.trajectory.body_qd.assign(twist)
    evaluating.state.start.assign(np.array([5.0, 9.0], np.float32))
    body = int(evaluating.layout.frame_body[evaluating.layout.frame("base/tip")])
    start = np.repeat([5.0, 9.0], 4)
    expected = start + np.array([[0.04], [0.08], [0.2]]) + 10.0 * np.array([[0.04], [0.04], [0.12]])
    expected = expected + 3.0 * twist[..., 5].reshape(4, 8, -1)[1:, :, body]
    np.testing.assert_allclose(evaluating.cost()[0], expected, rtol=1e-5)


def test_a_scalar_that_is_not_there_is_named():
    scene = make_scene(scalar={"speed": 3.0}, cost=[{"term": "clock", "frame": "base/tip", "scalar_speed": "sped"}])
    with pytest.raises(SceneError, match=r"cost\.clock\.scalar_speed.*no such scalar.*Did you mean 'speed'"):
        Evaluating(scene, BatchSize(1, 4, 1, 3), terms=[clock])
