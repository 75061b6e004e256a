# SPDX-License-Identifier: Apache-2.0
"""Policies as ONNX files, made here, whose controls are tried among the samples."""

import sys
from pathlib import Path

import numpy as np
import pytest
from needs import reason
from small_scenes import compiled, make_scene

from warpmpc import Controller, Plant, SceneError, State

onnx = pytest.importorskip("onnx", reason=reason("onnx"))
pytest.importorskip("onnxruntime", reason=reason("onnxruntime"))

PLANNER = {"samples": 24, "horizon": 8, "noise": {"sigma": (0.5,)}, "randomize": False}
FIRST = 2  # after the mean and the null particle


def save_linear(path: Path, matrix: np.ndarray, shape: list[int], *, read=None, kind=onnx.TensorProto.FLOAT) -> str:
    """Write the policy u = reshape(x · matrix) with an input [1, n] and an output of a shape."""
    helper = onnx.helper
    read = [1, matrix.shape[0]] if read is None else read
    numpy_kind = helper.tensor_dtype_to_np_dtype(kind)
    constants = [
        onnx.numpy_helper.from_array(matrix.astype(numpy_kind), "matrix"),
        onnx.numpy_helper.from_array(np.array(shape, dtype=np.int64), "shape"),
    ]
    nodes = [
        helper.make_node("MatMul", ["observation", "matrix"], ["flat"]),
        helper.make_node("Reshape", ["flat", "shape"], ["control"]),
    ]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", kind, read)],
        [helper.make_tensor_value_info("control", kind, shape)],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, path)
    return str(path)


def scene_with(policy: str, observation=("joint_q", "goal"), **planner):
    table = {"policy": policy, "observation": observation}
    return make_scene(planner={**PLANNER, **planner, "ancillary": table}, engine={"threads": 1})


def tried(scene, q) -> np.ndarray:
    """Knots [S, P, nu] that one plan tries from joint coordinates [nq]."""
    controller = Controller(scene, compiled=compiled(scene))
    controller.step(State(np.array(q), np.zeros(3), 0.0))
    return controller.plan_step.strategy.knots.numpy()[0]


def towards_the_goal(gain: float = 0.5) -> np.ndarray:
    """Matrix [10, 3] from joint_q (x, y, yaw) and the goal's pose to velocities that lead there."""
    matrix = np.zeros((10, 3))
    matrix[[0, 1], [0, 1]], matrix[[3, 4], [0, 1]] = -gain, gain
    return matrix


@pytest.mark.parametrize("read", [[1, 10], ["batch", 10], [10]])
def test_a_policy_proposes_from_the_state_and_the_task(read, tmp_path):
    scene = scene_with(save_linear(tmp_path / "policy.onnx", towards_the_goal(), [3], read=read))
    knots = tried(scene, [0.2, 0.1, 0.0])
    np.testing.assert_allclose(knots[FIRST], np.tile([0.4, 0.2, 0.0], (8, 1)), atol=1e-6)


@pytest.mark.parametrize("shape", [[1, 3], [8, 3], [1, 8, 3], [2, 8, 3], [1, 2, 8, 3], [4, 3]])
def test_a_policy_may_return_one_control_a_sequence_or_several(shape, tmp_path):
    rng = np.random.default_rng(0)
    matrix = rng.uniform(-0.3, 0.3, size=(10, int(np.prod(shape))))
    count = 4 if shape == [4, 3] else 8
    scene = scene_with(save_linear(tmp_path / "policy.onnx", matrix, shape), knots=count, spline="linear")
    knots, x = tried(scene, [0.2, 0.1, 0.3]), [0.2, 0.1, 0.3, 1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0]
    wanted = np.clip(x @ matrix, -1.0, 1.0).reshape(shape)
    if wanted.shape[-2:] == (1, 3):
        wanted = np.broadcast_to(wanted, (count, 3))
    wanted = wanted.reshape(-1, count, 3)
    np.testing.assert_allclose(knots[FIRST : FIRST + len(wanted)], wanted, atol=1e-5)
    assert np.abs(knots[FIRST + len(wanted)] - wanted[-1]).max() > 1e-3  # the next one is drawn


def test_a_policy_alone_drives_to_the_goal_where_noise_is_next_to_none(tmp_path):
    file = save_linear(tmp_path / "policy.onnx", towards_the_goal(2.0), [3])
    quiet = {"samples": 8, "method": "predictive_sampling", "noise": {"sigma": 1e-4, "null_sample": False}}
    success = {}
    for name, planner in (("with", quiet), ("alone", {**quiet, "ancillary": ()})):
        scene = scene_with(file)
        planner = {**PLANNER, "ancillary": scene.planner.ancillary, **planner}
        scene = make_scene(planner=planner, engine={"threads": 1})
        mpc = Controller(scene, compiled=compiled(scene))
        plant = Plant(scene, task=mpc.task, compiled=compiled(scene))
        while not plant.done:
            plant.apply(mpc.step(plant.observe()))
        success[name] = plant.success
    assert success == {"with": True, "alone": False}


def test_policies_that_do_not_fit_are_refused(tmp_path):
    def saved(name: str, *args, **more) -> str:
        return save_linear(tmp_path / f"{name}.onnx", *args, **more)

    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"no model")
    cases = (
        ("none.onnx", ("joint_q",), r"policy: no such"),
        (str(broken), ("joint_q",), r"policy: onnxruntime cannot read it"),
        (saved("wide", np.zeros((9, 3)), [3]), ("joint_q", "goal"), r"reads an array \[1, 9\].*allowed: \[10\]"),
        (saved("out", np.zeros((10, 4)), [4]), ("joint_q", "goal"), r"returns an array \[4\].*allowed: \[3\] or \[8"),
        (saved("scalar", np.zeros((10, 1)), []), ("joint_q", "goal"), r"returns an array \[\]"),
        (saved("long", np.zeros((10, 15)), [5, 3]), ("joint_q", "goal"), r"returns an array \[5, 3\]"),
        (
            saved("double", np.zeros((3, 3)), [3], kind=onnx.TensorProto.DOUBLE),
            ("joint_q",),
            r"has the inputs observation tensor\(double\)",
        ),
        (saved("fine", np.zeros((3, 3)), [3]), ("joint_p",), r"observation: nothing that a policy can read.*joint_q"),
    )
    for file, observation, message in cases:
        with pytest.raises(SceneError, match=r"planner\.ancillary\[0\]\..*" + message):
            tried(scene_with(file, observation), np.zeros(3))


def test_without_onnxruntime_one_line_says_what_to_install(tmp_path, monkeypatch):
    file = save_linear(tmp_path / "policy.onnx", towards_the_goal(), [3])
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(SceneError, match=r'ancillary\[0\]\.policy: needs onnxruntime: pip install "warpmpc\[onnx\]"'):
        tried(scene_with(file), np.zeros(3))
