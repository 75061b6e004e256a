# SPDX-License-Identifier: Apache-2.0
"""Samples that are not drawn: null particles, the best sample so far, a library; and what is carried out."""

import numpy as np
import pytest
from planning import Planning
from small_scenes import make_scene

from warpmpc import Controller, SceneError, State
from warpmpc.planner.proposers import sequences


@pytest.mark.parametrize(
    ("noise", "nulls"),
    [({}, 1), ({"null_share": 0.25}, 12), ({"null_share": 0.001}, 1), ({"null_sample": False, "null_share": 0.25}, 12)],
)
def test_a_share_of_the_samples_asks_for_nothing(noise, nulls):
    planning = Planning(envs=2, planner={"noise": {"sigma": (0.5,), **noise}})
    planning(3)
    assert not planning.knots[:, 1 : nulls + 1].any()
    assert np.all(np.abs(planning.knots[:, nulls + 1 :]).max(axis=(2, 3)) > 0.0)


def test_the_best_sample_is_moved_on_and_tried_again():
    planning = Planning(envs=2, planner={"keep_best": True, "noise": {"sigma": 0.5}})
    planning.q[1, :2] = [2.0, 1.0]
    planning()
    assert not planning.knots[:, 2].any()  # the first plan has none yet
    for _ in range(3):
        best = planning.cost.argmin(axis=1)
        kept = planning.knots[[0, 1], best]
        planning()
        np.testing.assert_array_equal(planning.knots[:, 2], np.concatenate([kept[:, 1:], kept[:, -1:]], axis=1))


def test_rounds_never_lose_the_best_sample():
    planning = Planning(envs=2, planner={"keep_best": True, "iterations": 3, "noise": {"sigma": 0.5}})
    planning.elapsed, lowest = 0.0, np.full(2, np.inf)
    for _ in range(4):
        planning()
        assert np.all(planning.cost.min(axis=1) <= lowest)
        lowest = planning.cost.min(axis=1)


def test_the_best_sample_is_rolled_out_anew():
    planning = Planning(planner={"keep_best": True, "noise": {"sigma": 0.5}})
    planning()
    planning.elapsed = 0.0
    best = planning.cost[0].min()
    planning()
    assert planning.cost[0, 2] == best
    planning.q[0, :2] = [-1.0, 0.0]  # farther away
    planning()
    assert planning.cost[0, 2] > best


def test_the_best_sample_stays_where_every_sample_diverged():
    planning = Planning(planner={"keep_best": True})
    planning.elapsed = 0.0
    planning(2)
    planning.qd[0, 0] = np.nan
    planning()
    kept = planning.knots[0, 2].copy()
    planning()
    np.testing.assert_array_equal(planning.knots[0, 2], kept)
    assert kept.any()


@pytest.mark.parametrize("method", ["mppi", "predictive_sampling", "cem"])
@pytest.mark.parametrize("keep_best", [False, True])
def test_the_best_sample_is_carried_out(method, keep_best):
    planner = {"method": method, "execute": "best", "keep_best": keep_best, "step_size": 0.5}
    planning = Planning(envs=2, planner=planner)
    planning.q[1, :2] = [2.0, 1.0]
    for _ in range(3):
        command = planning()[0]
        best = planning.knots[[0, 1], planning.cost.argmin(axis=1)]
        np.testing.assert_array_equal(command, best[:, 0])
        np.testing.assert_array_equal(planning.mean, best)
        # samples are drawn about the mean all the same
        assert not np.allclose(planning.strategy.distribution.mean.numpy(), best)


@pytest.mark.parametrize("form", ["fixed", "knots", "full"])
def test_a_sample_of_the_new_distribution_is_carried_out(form):
    planner = {"method": "mppi", "execute": "sample", "iterations": 2, "covariance": {"form": form}}
    planner |= {
        "samples": 24,
        "horizon": 6,
        "knots": "steps",
        "spline": "zero",
        "temperature": {"initial": 0.05, "eta": None},
    }
    planner["noise"] = {"sigma": 0.05, "shape": "identity"}
    planning, again, other = (Planning(envs=150, seed=seed, planner=planner) for seed in (0, 0, 1))
    commands = planning(2)
    np.testing.assert_array_equal(commands, again(2))
    assert not np.array_equal(commands, other(2))
    np.testing.assert_array_equal(commands[-1], planning.mean[:, 0])
    distribution = planning.strategy.distribution
    deviation = planning.mean.astype(np.float64) - distribution.mean.numpy()
    if form == "full":
        factor = distribution.covariance.factor.numpy().astype(np.float64)[:, None]
    else:
        factor = planning.sigma.astype(np.float64)[..., None] * np.eye(3)
    z = np.linalg.solve(np.broadcast_to(factor, (*deviation.shape, 3)), deviation[..., None])[..., 0]
    free = np.all(np.abs(planning.mean) < 1.0, axis=-1)  # what is at a limit is not normal
    assert free.mean() > 0.5
    assert np.abs(np.cov(z[free].T) - np.eye(3)).max() < 0.25
    assert np.abs(z[free].mean(axis=0)).max() < 0.2
    planning.plan.reset()
    np.testing.assert_array_equal(commands, planning(2))


def test_a_plan_is_what_is_carried_out():
    scene = make_scene(planner={"samples": 16, "horizon": 5, "execute": "best"})
    controller = Controller(scene, seed=1)
    state = State(controller.layout.joint_q, controller.layout.joint_qd, 0.0)
    command = controller.step(state)
    plan = Controller(scene, seed=1).plan(state)
    np.testing.assert_array_equal(plan.at(0.0), command)
    knots = controller.plan_step.strategy.knots.numpy()[0]
    np.testing.assert_array_equal(plan.knots, knots[controller.plan_step.engine.cost.numpy()[0].argmin()])


def saved(path, values: np.ndarray) -> str:
    """Write sequences [n, T, nu] into a file of the kind its name says."""
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez(path, control=values)
    else:
        np.savetxt(path, values.reshape(len(values), -1), delimiter=",")
    return str(path)


@pytest.mark.parametrize("kind", ["npy", "npz", "csv"])
def test_a_library_is_tried_at_every_plan_within_the_limits(kind, tmp_path):
    sequences = np.random.default_rng(0).normal(size=(4, 8, 3))
    file = saved(tmp_path / f"some.{kind}", sequences)
    planning = Planning(envs=2, planner={"sequences": file, "keep_best": True, "iterations": 2})
    for _ in range(3):
        planning()
        for e in range(2):
            np.testing.assert_allclose(planning.knots[e, 3:7], np.clip(sequences, -1.0, 1.0), rtol=1e-6)
    planning.plan.reset()
    planning()
    np.testing.assert_allclose(planning.knots[0, 3:7], np.clip(sequences, -1.0, 1.0), rtol=1e-6)


def test_a_library_lies_beside_its_scene(tmp_path):
    saved(tmp_path / "some.npy", np.zeros((2, 8, 3)))
    scene = make_scene(planner={"sequences": "some.npy", "horizon": 8}).model_copy(update={"path": tmp_path / "s.toml"})
    assert sequences(scene, 0.04 * np.arange(8), 3).shape == (2, 8, 3)


@pytest.mark.parametrize("spline", ["zero", "linear", "cubic", "bspline"])
@pytest.mark.parametrize("knots", [8, 4])
def test_a_control_for_every_step_becomes_the_nearest_knots(spline, knots, tmp_path):
    rng = np.random.default_rng(1)
    steps = np.repeat(rng.uniform(-0.5, 0.5, size=(3, 1, 3)), 8, axis=1)
    steps[1] += np.linspace(0.0, 0.3, 8)[:, None] * (spline != "zero")
    file = saved(tmp_path / "some.npy", steps)
    planning = Planning(planner={"sequences": file, "knots": knots, "spline": spline})
    planning()
    assert planning.knots.shape[2] == knots
    # constants and, but for steps, ramps are in the span of every spline
    np.testing.assert_allclose(planning.engine.recorded.control.numpy()[:, 2:5], steps.swapaxes(0, 1), atol=2e-6)


def test_a_library_of_knots_is_taken_as_it_is(tmp_path):
    sequences = np.random.default_rng(2).uniform(-1.0, 1.0, size=(2, 4, 3))
    planning = Planning(planner={"sequences": saved(tmp_path / "some.csv", sequences), "knots": 4, "spline": "cubic"})
    planning()
    np.testing.assert_allclose(planning.knots[0, 2:4], sequences, rtol=1e-6)


def ones(*shape: int) -> np.ndarray:
    return np.ones(shape)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("some.npy", ones(2, 7, 3), r"has the shape \[2, 7, 3\].*allowed: \[n, 8, 3\] or \[n, 4, 3\]"),
        ("some.npz", ones(2, 8, 2), r"has the shape \[2, 8, 2\]"),
        ("some.npy", ones(8, 3), r"has the shape \[8, 3\]"),
        ("some.npy", ones(0, 8, 3), r"has the shape \[0, 8, 3\]"),
        ("some.csv", ones(2, 23), r"has the shape \[2, 23\].*allowed: lines of 24 numbers or lines of 12 numbers"),
        ("some.npy", np.full((1, 8, 3), np.nan), "not finite"),
        ("some.npy", np.array([["a"]]), "cannot be read as numbers"),
        ("some.npy", np.array([{}], dtype=object), "cannot be read as numbers"),
    ],
)
def test_a_library_that_does_not_fit_is_refused(name, values, message, tmp_path):
    file = saved(tmp_path / name, values)
    with pytest.raises(SceneError, match=r"planner\.sequences: .*" + message):
        Planning(planner={"sequences": file, "knots": 4, "spline": "linear"})


def test_a_library_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "some.txt").write_text("1, 2")
    (tmp_path / "some.csv").write_text("one, two")
    (tmp_path / "broken.npz").write_bytes(b"PK")
    np.save(tmp_path / "lies.npy", ones(100, 8, 3))
    content = (tmp_path / "lies.npy").read_bytes()
    (tmp_path / "lies.npy").write_bytes(content.replace(b"(100, 8, 3)", b"(9" + b"9" * 16 + b", 8, 3)", 1))
    np.savez(tmp_path / "two.npz", a=ones(1, 8, 3), b=ones(1, 8, 3))
    for name, message in (
        ("some.txt", "is no file of arrays.*allowed: .csv, .npy, .npz"),
        ("some.csv", "cannot be read as numbers"),
        ("lies.npy", "cannot be read as numbers"),
        ("broken.npz", "cannot be read as numbers"),
        ("two.npz", "holds 2 arrays, not one"),
        ("none.npy", "no such"),
    ):
        with pytest.raises(SceneError, match=r"planner\.sequences: .*" + message):
            Planning(planner={"sequences": str(tmp_path / name)})


def test_more_fixed_samples_than_samples_are_refused(tmp_path):
    file = saved(tmp_path / "some.npy", ones(10, 8, 3))
    Planning(planner={"samples": 12, "sequences": file})()
    with pytest.raises(SceneError, match=r"planner\.samples: the mean and 12 fixed samples"):
        Planning(planner={"samples": 12, "sequences": file, "keep_best": True})
