# SPDX-License-Identifier: Apache-2.0
"""Samples that something else proposes: functions of a user's own, stored motions, policies as ONNX.

Slow ones by hand: pytest -m slow tests/planner/test_ancillary.py
"""

from pathlib import Path

import numpy as np
import pytest
from small_scenes import DISC, WALL, compiled, make_scene

from warpmpc import Controller, Plant, RunLog, RunRecorder, SceneError, State, Task, ancillary, load_terms, run_episode
from warpmpc.planner.recall import Nearness

PLANNER = {"samples": 24, "horizon": 8, "noise": {"sigma": (0.5,)}, "randomize": False}
FIRST = 2  # after the mean and the null particle


def scene_with(*ancillaries: dict, **planner):
    """The disc that drives to (1, 0.5), with things that propose samples."""
    return make_scene(planner={**PLANNER, **planner, "ancillary": list(ancillaries)}, engine={"threads": 1})


def plan(scene, terms=(), *, envs: int = 1, states=None, speeds=None, task=None) -> np.ndarray:
    """Knots [E, S, P, nu] that one plan tries."""
    controller = Controller(scene, terms=terms, envs=envs, compiled=compiled(scene), task=task)
    state = State.start(controller.layout)
    q = np.tile(state.joint_q, (envs, 1)) if states is None else np.array(states, dtype=float)
    controller.step(State(q, np.zeros_like(q) if speeds is None else np.array(speeds), 0.0))
    return controller.plan_step.strategy.knots.numpy()


@ancillary("straight")
def straight(state, task, times):
    way = task["goal"][:2] - state.joint_q[:2]
    return [0.5 * way[0], 0.5 * way[1], 0.0]


@ancillary("pair", samples=2)
def pair(state, task, times):
    one = np.zeros((len(times), 3))
    one[:, 0] = times
    return [one, -one]


def test_a_function_proposes_from_every_environments_own_state_and_task():
    scene = scene_with({"function": "straight"})
    task = Task(scene, envs=2)
    task["goal"] = [[0.4, 0.6, 0.0, 0.0, 0.0, 0.0, 1.0], [0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 1.0]]
    knots = plan(scene, [straight], envs=2, states=[[0.0, 0.0, 0.0], [0.2, 0.2, 0.0]], task=task)
    np.testing.assert_allclose(knots[0, FIRST], np.tile([0.2, 0.3, 0.0], (8, 1)), atol=1e-6)
    np.testing.assert_allclose(knots[1, FIRST], np.tile([-0.1, -0.2, 0.0], (8, 1)), atol=1e-6)
    assert knots[0, FIRST + 1].std() > 0.1  # the next one is drawn


@pytest.mark.parametrize(("spline", "count"), [("zero", 8), ("linear", 4), ("cubic", 3)])
def test_controls_for_every_step_become_knots_of_each_of_several_samples(spline, count):
    scene = scene_with({"function": "pair"}, {"function": "straight"}, spline=spline, knots=count)
    knots = plan(scene, [straight, pair])
    times = 0.04 * (np.arange(8) if count == 8 else np.linspace(0.0, 7.0, count))
    np.testing.assert_allclose(knots[0, FIRST, :, 0], times, atol=1e-5)  # a ramp is in the span of every spline
    np.testing.assert_allclose(knots[0, FIRST + 1, :, 0], -times, atol=1e-5)
    np.testing.assert_allclose(knots[0, FIRST + 2], np.tile([0.5, 0.25, 0.0], (count, 1)), atol=1e-6)


@pytest.mark.parametrize("answer", [None, [np.nan, 0.0, 0.0]])
def test_without_a_proposal_the_sample_asks_for_nothing(answer):
    calls = []

    @ancillary("shy")
    def shy(state, task, times):
        calls.append(state.time)
        return [0.7, 0.0, 0.0] if len(calls) != 3 else answer  # the first is the trial

    scene = scene_with({"function": "shy"})
    controller = Controller(scene, terms=[shy], compiled=compiled(scene))
    seen = []
    for i in range(3):
        controller.step(State(controller.layout.joint_q, controller.layout.joint_qd, 0.04 * i))
        seen.append(controller.plan_step.strategy.knots.numpy()[0, FIRST, 0, 0])
    np.testing.assert_allclose(seen, [0.7, 0.0, 0.7], atol=1e-6)
    assert calls == [None, 0.0, 0.04, 0.08]


def test_who_is_not_observed_is_not_asked():
    asked = []

    @ancillary("counts")
    def counts(state, task, times):
        asked.append(float(state.joint_q[0]))
        return [0.0, 0.0, 0.0]

    scene = scene_with({"function": "counts"})
    controller = Controller(scene, terms=[counts], envs=2, compiled=compiled(scene))
    asked.clear()
    controller.step(State(np.array([[0.1, 0.0, 0.0], [np.nan, 0.0, 0.0]]), np.zeros((2, 3)), 0.0))
    assert asked == [pytest.approx(0.1)]


def failing(answer):
    @ancillary("wrong", samples=1)
    def wrong(state, task, times):
        return answer() if callable(answer) else answer

    return wrong


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.zeros(2), r"returns an array \[2\].*allowed: \[3\] or \[8, 3\] or \[4, 3\]"),
        (np.zeros((7, 3)), r"returns an array \[7, 3\]"),
        (np.zeros((2, 8, 3)), r"returns an array \[2, 8, 3\]"),
        ("text", "could not convert"),
        (lambda: 1 / 0, r"test_ancillary.py:\d+: ZeroDivisionError: division by zero"),
        ([np.inf, 0.0, 0.0], "not finite"),
    ],
)
def test_a_function_that_returns_something_else_is_refused_by_its_line(answer, message):
    scene = scene_with({"function": "wrong"}, knots=4, spline="linear")
    with pytest.raises(SceneError, match=r"planner\.ancillary\[0\]\.function: .*" + message):
        plan(scene, [failing(answer)])


def test_an_unknown_function_is_told_with_those_that_there_are():
    with pytest.raises(SceneError, match=r"ancillary\[0\]\.function: no such.*--terms.*allowed: pair, straight"):
        plan(scene_with({"function": "strait"}), [straight, pair])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "needs one of function, motions, recall and policy; found none of them"),
        ({"function": "a", "policy": "b.onnx"}, "found function, policy"),
        ({"function": "a", "nearest": 2}, "'nearest' is a key of motions, not of function"),
        ({"motions": "a.npz", "observation": "joint_q"}, "'observation' is a key of policy, not of motions"),
    ],
)
def test_tables_name_one_thing_and_its_own_keys(table, message):
    with pytest.raises(ValueError, match=message):
        scene_with(table)


def test_a_scene_that_is_built_from_its_own_data_is_the_same():
    scene = scene_with({"function": "straight"}, {"policy": "a.onnx", "observation": "goal"}, {"motions": "b.npz"})
    assert type(scene).model_validate(scene.model_dump()).planner == scene.planner


def test_more_proposals_than_samples_are_refused():
    with pytest.raises(SceneError, match=r"planner\.samples: the mean and 3 fixed samples \(.*ancillary\)"):
        plan(scene_with({"function": "pair"}, samples=3), [pair])


def test_files_of_terms_may_bring_them(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        'import warpmpc\n\n@warpmpc.ancillary("still")\ndef still(state, task, times):\n    return [0, 0, 1]\n'
    )
    (mine,) = load_terms(file)
    knots = plan(scene_with({"function": "still"}), [mine])
    np.testing.assert_allclose(knots[0, FIRST, :, 2], 1.0)


def save_motions(path: Path, **changes) -> Path:
    """Four motions from the corners of a square, each of which turns another way round."""
    corners = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 1.0, 0.0]])
    control = np.zeros((4, 3, 3))
    control[:, :, 2] = np.arange(4)[:, None] / 10.0 + np.array([0.0, 0.3, 0.6])
    arrays = {"joint_q": corners, "joint_qd": np.zeros((4, 3)), "control": control, "time": [0.0, 0.08, 0.2]}
    np.savez(path, **{**arrays, **changes})
    return path


def test_the_nearest_motions_are_tried_nearest_first(tmp_path):
    file = save_motions(tmp_path / "some.npz")
    scene = scene_with({"motions": str(file), "nearest": 2})
    knots = plan(scene, envs=2, states=[[1.8, 0.3, 0.0], [0.1, 0.6, 0.0]])
    # x counts by 1 and y by 2: both by their spread
    held = np.repeat([0.0, 0.3, 0.6], [2, 3, 3])
    for e, order in enumerate(([1, 3], [2, 0])):
        for i, motion in enumerate(order):
            np.testing.assert_allclose(knots[e, FIRST + i, :, 2], motion / 10.0 + held, atol=1e-6)


def test_joints_say_what_is_near(tmp_path):
    file = save_motions(tmp_path / "some.npz")
    knots = plan(scene_with({"motions": str(file), "joints": "base/y"}), states=[[2.0, 0.9, 0.0]])
    assert knots[0, FIRST, 0, 2] == pytest.approx(0.2)  # of those at y = 1 the first


def test_a_recorded_run_is_a_library_of_its_own_states(tmp_path):
    scene = scene_with()
    run_episode(scene, seed=1, compiled=compiled(scene), recorder=Saved(tmp_path / "run.npz"))
    log = RunLog.load(tmp_path / "run.npz")
    states, sent = log.states, log.controls.control
    at = 7
    scene = scene_with({"motions": str(tmp_path / "run.npz")})
    knots = plan(scene, states=states.joint_q[[at]], speeds=states.joint_qd[[at]])
    controls = sent[at : at + 8]
    np.testing.assert_allclose(knots[0, FIRST], controls, atol=1e-5)
    last = len(sent) - 1
    knots = plan(scene, states=states.joint_q[[last]], speeds=states.joint_qd[[last]])
    np.testing.assert_allclose(knots[0, FIRST], np.tile(sent[last], (8, 1)), atol=1e-5)


class Saved:
    """Makes the recorder of an episode and saves what it kept."""

    def __init__(self, path: Path):
        self.path = path

    def __call__(self, controller, plant):
        self.recorder = RunRecorder(plant, controller)
        return self

    def log(self, control):
        self.recorder.log(control)

    def close(self):
        self.recorder.run_log.save(self.path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control": np.zeros((4, 3, 2))}, r"control is \[4, 3, 2\], not \[N, K, 3\] or, of a run, \[N, 3\]"),
        ({"joint_q": np.zeros((3, 3))}, r"joint_q is \[3, 3\], not \[4, 3\]"),
        ({"time": [0.0, 0.2, 0.1]}, "not 3 ascending numbers"),
        ({"joint_qd": np.full((4, 3), np.nan)}, "not finite"),
    ],
)
def test_motions_that_do_not_fit_are_refused(changes, message, tmp_path):
    file = save_motions(tmp_path / "some.npz", **changes)
    with pytest.raises(SceneError, match=r"planner\.ancillary\[0\]\.motions: is no file of motions: .*" + message):
        plan(scene_with({"motions": str(file)}))


def test_motions_that_are_missing_or_too_few_are_refused(tmp_path):
    file = save_motions(tmp_path / "some.npz")
    np.savez(tmp_path / "half.npz", control=np.zeros((4, 3, 3)))
    for table, message in (
        ({"motions": "none.npz"}, r"motions: no such"),
        ({"motions": str(tmp_path / "half.npz")}, r"it lacks joint_q, joint_qd, time"),
        ({"motions": str(file), "nearest": 5}, r"nearest: the file has 4 motions; found 5"),
        ({"motions": str(file), "joints": "base/w"}, r"ancillary\[0\]\.joints: no such joint; found 'base/w'"),
    ):
        with pytest.raises(SceneError, match=message):
            plan(scene_with(table))


def test_a_turn_is_compared_the_short_way_round_and_a_quaternion_with_either_sign():
    scene = make_scene(
        object=[{"name": "ball", "shape": "sphere", "size": 0.1, "mass": 1.0, "position": (2.0, 0, 0.1)}]
    )
    layout = compiled(scene).layout
    rng, n = np.random.default_rng(0), 6
    states = rng.normal(size=(n, layout.nq + layout.nv))
    states[:, 6:10] /= np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    near = Nearness(layout, states, np.arange(states.shape[1]))
    other = states[3].copy()
    other[6:10] *= -1.0
    assert near(other)[3] == pytest.approx(0.0, abs=1e-6)
    assert near(other).argmin() == 3
    endless = [c for c, name in zip(layout.dof_coord, layout.dof_name, strict=True) if name == "base/yaw"]
    assert endless
    other[endless] += 2.0 * np.pi
    assert near(other)[3] == pytest.approx(0.0, abs=1e-6)


NICHE = [
    {**WALL, "name": "front", "size": (0.1, 1.3, 0.4), "position": (0.9, 0.0, 0.2)},
    {**WALL, "name": "left", "size": (0.4, 0.1, 0.4), "position": (0.65, 0.6, 0.2)},
    {**WALL, "name": "right", "size": (0.4, 0.1, 0.4), "position": (0.65, -0.6, 0.2)},
]
CORNERS = np.array([[0.1, 0.3], [0.3, 1.0], [1.3, 1.0], [1.6, 0.0]])


@ancillary("around")
def around(state, task, times):
    """Drives from corner to corner around the niche, at 1 m/s."""
    at = state.joint_q[:2].astype(float)
    corner = 3 if at[0] > 1.2 else 2 if at[1] > 0.85 else 1 if at[0] < 0.3 else 0
    controls = []
    for _ in times:
        if corner < 3 and np.hypot(*(CORNERS[corner] - at)) < 0.1:
            corner += 1
        way = CORNERS[corner] - at
        speed = way / max(np.hypot(*way), 0.1)
        controls.append([*speed, 0.0])
        at += 0.08 * speed
    return controls


@pytest.mark.parametrize("method", ["predictive_sampling", pytest.param("mppi", marks=pytest.mark.slow)])
def test_a_way_out_of_a_niche_is_found_with_a_proposal_and_not_without(method):
    """The goal is behind the wall: what is drawn about a plan that leads into the niche leads into it, too."""
    reached = {}
    for name, more in (("alone", ()), ("with", ({"function": "around"},))):
        scene = make_scene(
            timing={"control_dt": 0.08, "timeout": 6.0},
            robot=[{**DISC, "joint_q": (0.3, 0.0, 0.0)}],
            obstacle=NICHE,
            goal={"frame": "base/centre", "position": (1.6, 0.0)},
            planner={**PLANNER, "method": method, "samples": 64, "horizon": 48, "discount": 1.0, "ancillary": more},
            engine={"name": "fused", "threads": 1},
        )
        reached[name] = []
        for seed in range(2):
            mpc = Controller(scene, terms=[around], seed=seed, compiled=compiled(scene))
            plant = Plant(scene, seed=seed, task=mpc.task, compiled=compiled(scene))
            while not plant.done:
                plant.apply(mpc.step(plant.observe()))
            reached[name].append(plant.success)
    assert reached == {"alone": [False, False], "with": [True, True]}
