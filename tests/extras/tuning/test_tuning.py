# SPDX-License-Identifier: Apache-2.0
"""Tuning: what a search space may say, what an episode is worth, and a study that is made and taken up again."""

from concurrent.futures import Future
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import warpmpc
from warpmpc import shipped_scenes
from warpmpc.extras.tuning.search import FAILED_COST, Outcome, Score
from warpmpc.extras.tuning.space import (
    Choice,
    Factor,
    Range,
    bind_space,
    derive_space,
    parse_parameter,
    parse_space,
    present,
)
from warpmpc.scene.task.goal import GoalError

pytest.importorskip("optuna", reason="tuning needs optuna")
from optuna.trial import TrialState

from warpmpc.extras.tuning.search import Task, best, done, open_study, search


@pytest.mark.parametrize(
    ("text", "parameter"),
    [
        ("cost.yaw.weight=0.5..6:log", Range("cost.yaw.weight", 0.5, 6.0, True, False)),
        ("planner.knots=3..8", Range("planner.knots", 3, 8, False, True)),
        ("planner.samples=16..512:log", Range("planner.samples", 16, 512, True, True)),
        ("a.b = -1e-3 .. .5", Range("a.b", -0.001, 0.5, False, False)),
        ("planner.noise.sigma[0]=0.1..1", Range("planner.noise.sigma.0", 0.1, 1.0, False, False)),
        ("planner.noise.sigma=x0.2..5", Factor("planner.noise.sigma", 0.2, 5.0)),
        ("planner.spline=zero|cubic", Choice("planner.spline", ("zero", "cubic"))),
        ("x.y=false|[1.0, 2.0]", Choice("x.y", ("false", "[1.0, 2.0]"))),
    ],
)
def test_a_search_space_is_read(text, parameter):
    assert parse_parameter(text) == parameter


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("planner.knots", "no such file"),
        ("=1..2", "must have the form"),
        ("planner.knots=", "must have the form"),
        ("planner.knots=3", "no range and no choice"),
        ("planner.knots=3..8:lin", "no range and no choice"),
        ("planner.knots=3-8", "no range and no choice"),
        ("planner.knots=8..3", "low end must be below"),
        ("cost.yaw.weight=0..6:log", "above zero"),
        ("planner.noise.sigma=x0..5", "above zero"),
        ("planner.spline=zero|", "is not a TOML value"),
        ("planner.spline=zero|[1", "is not a TOML value"),
        ("planner.spline=zero|zero", "stands there twice"),
        ("planner..knots=1..2", "is not a dotted key"),
    ],
)
def test_a_bad_search_space_is_refused_with_a_message(text, says):
    with pytest.raises(ValueError, match=r"^--key ") as error:
        parse_space([text])
    assert says in str(error.value)


def test_keys_come_from_files_too(tmp_path):
    (tmp_path / "keys").write_text("# weights\ncost.yaw.weight=1..2  # whole\n\nplanner.knots=3..8\n")
    space = parse_space([str(tmp_path / "keys"), "planner.discount=0.9..1.0"])
    assert [parameter.key for parameter in space] == ["cost.yaw.weight", "planner.knots", "planner.discount"]
    with pytest.raises(ValueError, match="named twice"):
        parse_space([str(tmp_path / "keys"), "planner.knots=2..3"])


def test_the_start_is_what_the_scenes_say():
    keys = ["planner.noise.sigma=[0.4, 0.4, 0.7]", "planner.temperature.eta=[2.5, 5.0]"]
    scenes = {name: warpmpc.load_scene(name, overrides=keys) for name in ("omni_push_box:A", "omni_push_box:B")}
    texts = [
        "planner.noise.sigma[2]=0.01..9.0",
        "planner.temperature.eta=false|[2.5, 5.0]",
        "cost.yaw.weight=0.1..99.0",
    ]
    space, start = bind_space(parse_space([*texts, "planner.noise.sigma=x0.1..2"]), scenes, keys)
    scene = scenes["omni_push_box:A"]
    assert start["planner.noise.sigma.2"] == scene.planner.noise.sigma[2]
    assert start["planner.temperature.eta"] == "[2.5, 5.0]"
    assert start["cost.yaw.weight"] == next(cost.weight for cost in scene.cost if cost.label == "yaw")
    assert start["planner.noise.sigma"] == 1.0
    assert space[-1].text(1.0) == repr([float(value) for value in scene.planner.noise.sigma])
    assert space[-1].text(0.5) == repr([0.5 * value for value in scene.planner.noise.sigma])


@pytest.mark.parametrize("name", sorted(shipped_scenes()))
def test_a_space_follows_from_every_scene_and_holds_what_the_scene_has(name):
    scene = warpmpc.load_scene(name)
    space, start = bind_space(parse_space(derive_space(scene)), {name: scene}, [])
    assert len(space) >= 2
    task = Task(scenes={name: scene}, space=space, start=start, seeds=[0], contact_penalty=5.0)
    same = warpmpc.load_scene(name, overrides=task.changes(start))
    assert same.planner.noise.sigma == scene.planner.noise.sigma
    assert [cost.weight for cost in same.cost] == [cost.weight for cost in scene.cost]
    free = [p for p in space if p.key not in ("planner.horizon", "planner.knots", "planner.elites")]  # bound each other
    for parameter in free:
        for end in (parameter.low, parameter.high):
            warpmpc.load_scene(name, overrides=[f"{parameter.key}={parameter.text(end)}"])


def test_no_range_leaves_what_the_key_allows():
    assert any(
        text.startswith("planner.temperature.ess=1.0..") for text in derive_space(warpmpc.load_scene("quadrotor"))
    )


def test_a_key_holds_what_the_scene_says():
    scene = warpmpc.load_scene("omni_push_box")
    assert present(scene, "robot.base.joint_q.1") == {"robot.base.joint_q.1": 2.0}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("planner.sampels=16..32", "Did you mean 'samples'?"),
        ("planner.samples=1000000..2000000", "lies outside 1000000..2000000"),
        ("planner.noise.sigma=0.1..1.0", "tune its values apart, as planner.noise.sigma[0]"),
        ("planner.spline=zero|linear", "is not among zero|linear"),
        ("cost.distance.near=0.1..1.0", "--set cost.distance.near=VALUE"),
        ("cost.*.weight=0.001..100.0", "stands for several values"),
    ],
)
def test_a_start_outside_the_space_is_refused(text, says):
    scene = warpmpc.load_scene("point_reach", overrides=["planner.noise.sigma=[0.8, 0.8, 0.2]"])
    with pytest.raises(ValueError, match=r"^--") as error:
        bind_space(parse_space([text]), {"point_reach": scene}, [])
    assert says in str(error.value)


def worth(
    scene, *, time=None, error=0.0, start=2.0, yaw=0.0, force=0.0, contact=0.0, reason="timeout", end=1.0
) -> float:
    """Value of an episode that begins and ends with some errors."""
    ends = [GoalError(axes=np.array([p]), yaw=y, rotation=y) for p, y in ((start, 0.0), (error, yaw))]
    plant = SimpleNamespace(error=ends[0])
    score = Score(scene, plant, contact_penalty=5.0)
    plant.error = ends[1]
    result = SimpleNamespace(
        success=time is not None,
        passed=time is not None,
        time_to_goal=time,
        reason=reason,
        sim_time=end,
        max_force=force,
        time_in_contact=contact,
    )
    return score.outcome(result).value


def test_an_episodes_worth():
    scene = warpmpc.load_scene("omni_push_box")
    assert worth(scene, time=12.0) == 12.0
    assert worth(scene, time=12.0, force=4.0, contact=3.0) == worth(scene, time=12.0, force=400.0, contact=0.05) == 12.0
    assert worth(scene, time=12.0, force=6.0, contact=0.2) == 17.0
    values = [{"time": 45.0}, {"error": 0.06}, {"error": 0.06, "yaw": 1.0}, {"error": 2.0}, {"error": 3.0}]
    order = [worth(scene, **what) for what in values]
    assert order == sorted(set(order))
    assert worth(scene, error=0.06) > 2.0 * scene.timing.timeout
    assert worth(scene, error=1e9) == worth(scene, error=float("nan")) == scene.timing.timeout * 4.0


@pytest.mark.parametrize("reason", ["failed: fallen", "the plant's physics diverged"])
def test_a_failure_is_worse_than_any_success_or_survivor(reason):
    scene = warpmpc.load_scene("omni_push_box", overrides=["timing.timeout=4.0"])
    hit = {"force": 400.0, "contact": 3.0}
    success, survivor = worth(scene, time=4.0, **hit), worth(scene, error=1e9, yaw=3.14, **hit)
    assert success <= worth(scene, error=0.06)
    near = worth(scene, error=0.06, reason=reason, end=4.0)
    assert survivor < near < worth(scene, error=0.06, reason=reason, end=2.0)
    assert near < worth(scene, error=2.0, reason=reason, end=4.0)


def test_without_a_success_the_mean_cost_at_the_scenes_own_weights_counts():
    scene = warpmpc.load_scene("pendulum")
    scene = scene.model_copy(update={"success": None, "timing": scene.timing.model_copy(update={"timeout": 0.2})})
    steps = round(0.2 / scene.timing.control_dt)
    labels = {cost.label: cost.weight for cost in scene.cost}
    plant = SimpleNamespace(error=None, terms=dict.fromkeys(labels, 2.0), steps=0)
    score = Score(scene, plant, contact_penalty=5.0)
    for plant.steps in range(1, steps + 1):
        score(None, plant, None)
    whole = score.outcome(SimpleNamespace(passed=True)).value
    assert whole == pytest.approx(2.0 * sum(labels.values()))
    plant.terms = dict.fromkeys(labels, 4.0)
    score = Score(scene, plant, contact_penalty=5.0)
    plant.steps = 1
    score(None, plant, None)
    assert score.outcome(SimpleNamespace(passed=False)).value == pytest.approx(2.0 * whole + FAILED_COST, rel=1e-12)


class FakeEpisodes:
    """Runs no episodes: the time to the goal is the key's value, plus the seed's last digit."""

    def __init__(self):
        self.seeds = []

    def __call__(self, source, seed, changes):
        """Answer at once."""
        self.seeds.append(seed)
        future = Future()
        future.set_result(Outcome(float(changes[-1].partition("=")[2]) + seed % 10, True))
        return future


@pytest.fixture
def task():
    scenes = {"point_reach": warpmpc.load_scene("point_reach")}
    space, start = bind_space(parse_space(["cost.distance.weight=0.5..50"]), scenes, [])
    return Task(scenes=scenes, space=space, start=start, seeds=[500, 501, 502], contact_penalty=5.0)


def test_a_search_begins_with_the_start_prunes_and_finds_the_best(tmp_path, task):
    study, episodes, seen = open_study(tmp_path / "a.db", task), FakeEpisodes(), []
    for weight in (5.0, 6.0, 0.7, 8.0, 49.0):
        study.enqueue_trial({"cost.distance.weight": weight})
    search(study, task, episodes, parallel=1, trials=8, on_trial=seen.append)
    assert len(done(study)) == len(seen) == 8
    assert seen[0].params == task.start
    assert seen[0].value == pytest.approx(task.start["cost.distance.weight"] + 1.0)
    assert episodes.seeds[:3] == task.seeds
    assert seen[5].state is TrialState.PRUNED
    assert seen[5].user_attrs["scores"] == [49.0]
    assert len(episodes.seeds) == sum(len(trial.user_attrs["scores"]) for trial in seen)
    assert study.best_value == min(trial.value for trial in seen if trial.state is TrialState.COMPLETE) <= 1.7
    found, start, values = best(study, task)
    assert start is seen[0] or start.number == 0
    assert found.value == study.best_value
    assert values == {"cost.distance.weight": pytest.approx(0.7, abs=0.3)}


def test_values_that_make_no_scene_are_passed_over(tmp_path, task):
    bad = replace(task, space=[Range("timing.timeout", 0.001, 60.0, False, False), *task.space], seeds=[500])
    bad.start["timing.timeout"] = 45.0
    study, seen = open_study(tmp_path / "a.db", bad), []
    study.enqueue_trial({"timing.timeout": 0.001, "cost.distance.weight": 1.0})
    study.enqueue_trial({"timing.timeout": 10.0, "cost.distance.weight": 1.0})
    search(study, bad, FakeEpisodes(), parallel=1, trials=3, on_trial=seen.append)
    assert "shorter than timing.control_dt" in seen[1].user_attrs["refused"]
    assert [trial.state for trial in seen] == [TrialState.COMPLETE, TrialState.PRUNED, TrialState.COMPLETE]


def test_what_was_interrupted_is_tried_again(tmp_path, task):
    study = open_study(tmp_path / "a.db", task)
    for _ in range(2):  # the start and one more
        task.space[0].suggest(study.ask())
    lost = [trial.params for trial in study.trials]
    study, seen = open_study(tmp_path / "a.db", task), []
    search(study, task, FakeEpisodes(), parallel=1, trials=2, on_trial=seen.append)
    assert [trial.params for trial in seen] == lost
    assert seen[0].user_attrs["start"]
