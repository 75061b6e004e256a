# SPDX-License-Identifier: Apache-2.0
"""Tuning: what a search space may say, what an episode is worth, and a study that is made and taken up again."""

import subprocess
import sys
from concurrent.futures import Future
from pathlib import Path

import optuna
import pytest
import tune as program
from jobs import run_job
from optuna.trial import TrialState
from tuning.objective import score
from tuning.search import Task, done, open_study, search
from tuning.space import Choice, Range, parse_parameter, parse_space, start_values

import warpmpc

TOOL = Path(__file__).parents[2] / "tools" / "tune.py"
KEYS = [
    "cost.reach.weight=0.1..6:log",
    "planner.knots=2..4",
    "planner.noise.sigma[0]=0.3..2",
    "planner.spline=linear|cubic",
]
SHIPPED = "omni_push_box"
"""A scene that is compiled once, whatever its episodes draw."""
TINY = ["--set", "planner.samples=16", "--set", "planner.horizon=4", "--set", "timing.timeout=0.4"]


def tune(*args: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the tool as a user does."""
    command = [sys.executable, TOOL, *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8", timeout=280)


@pytest.mark.parametrize(
    ("text", "parameter"),
    [
        ("cost.yaw.weight=0.5..6:log", Range("cost.yaw.weight", 0.5, 6.0, True, False)),
        ("planner.knots=3..8", Range("planner.knots", 3, 8, False, True)),
        ("planner.samples=16..512:log", Range("planner.samples", 16, 512, True, True)),
        ("a.b = -1e-3 .. .5", Range("a.b", -0.001, 0.5, False, False)),
        ("planner.noise.sigma[0]=0.1..1", Range("planner.noise.sigma.0", 0.1, 1.0, False, False)),
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
    scenes = {name: warpmpc.load_scene(name) for name in ("omni_push_box:A", "omni_push_box:B")}
    texts = [
        "planner.noise.sigma[2]=0.01..9.0",
        "planner.temperature.eta=false|[2.5, 5.0]",
        "cost.yaw.weight=0.1..99.0",
    ]
    start = start_values(parse_space(texts), scenes, [])
    scene = scenes["omni_push_box:A"]
    assert start["planner.noise.sigma.2"] == scene.planner.noise.sigma[2]
    assert start["planner.temperature.eta"] == "[2.5, 5.0]"
    assert start["cost.yaw.weight"] == next(cost.weight for cost in scene.cost if cost.label == "yaw")


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
    with pytest.raises(ValueError, match=r"^--") as error:
        start_values(parse_space([text]), {"point_reach": warpmpc.load_scene("point_reach")}, [])
    assert says in str(error.value)


def run(*, time=None, error=0.0, start=2.0, yaw=0.0, force=0.0, contact=0.0) -> dict:
    """What a worker says of an episode, as far as its worth depends on it."""
    return {
        "result": {
            "success": time is not None,
            "time_to_goal_s": time,
            "reason": "goal reached" if time is not None else "timeout",
            "final": {"position_error_m": error, "yaw_error_rad": yaw},
            "collisions": {"max_force_N": force, "time_in_contact_s": contact},
        },
        "measured": {"start_position_error_m": start, "rotation_error_rad": 0.0},
    }


def test_an_episodes_worth():
    scene = warpmpc.load_scene("omni_push_box")

    def worth(**what) -> float:
        return score(run(**what), scene, contact_penalty=5.0)

    assert worth(time=12.0) == 12.0
    assert worth(time=12.0, force=4.0, contact=3.0) == worth(time=12.0, force=400.0, contact=0.05) == 12.0
    assert worth(time=12.0, force=6.0, contact=0.2) == 17.0
    order = [worth(time=45.0), worth(error=0.06), worth(error=0.06, yaw=1.0), worth(error=2.0), worth(error=3.0)]
    assert order == sorted(set(order))
    assert worth(error=0.06) > 2.0 * scene.timing.timeout
    assert worth(error=1e9) == worth(error=None) == scene.timing.timeout * 4.0


class FakeWorkers:
    """Runs no episodes: the time to the goal is the key's value, plus the seed's last digit."""

    count = 1

    def __init__(self):
        self.jobs = []

    def submit(self, function, job):
        """Answer at once."""
        assert function is run_job
        self.jobs.append(job)
        weight = float(job.overrides[-1].partition("=")[2])
        future = Future()
        future.set_result(run(time=weight + job.seed % 10))
        return future


@pytest.fixture
def task():
    scenes = {"point_reach": warpmpc.load_scene("point_reach")}
    space = parse_space(["cost.distance.weight=0.5..50"])
    start = start_values(space, scenes, [])
    return Task(scenes=scenes, space=space, start=start, seeds=[10000, 10001, 10002], contact_penalty=5.0)


def test_a_search_begins_with_the_start_prunes_and_finds_the_best(tmp_path, task):
    study, workers, seen = open_study(tmp_path / "a.db", task), FakeWorkers(), []
    for weight in (5.0, 6.0, 0.7, 8.0, 49.0):
        study.enqueue_trial({"cost.distance.weight": weight})
    search(study, task, workers, trials=8, on_trial=seen.append)
    assert len(done(study)) == len(seen) == 8
    assert seen[0].params == task.start
    assert seen[0].value == pytest.approx(task.start["cost.distance.weight"] + 1.0)
    assert [job.seed for job in workers.jobs[:3]] == task.seeds
    assert seen[5].state is TrialState.PRUNED
    assert seen[5].user_attrs["scores"] == [49.0]
    assert len(workers.jobs) == sum(len(trial.user_attrs["scores"]) for trial in seen)
    assert study.best_value == min(trial.value for trial in seen if trial.state is TrialState.COMPLETE) <= 1.7


def test_values_that_make_no_scene_are_passed_over(tmp_path):
    scenes = {"omni_push_box": warpmpc.load_scene("omni_push_box")}
    space = parse_space(["planner.spline=zero|cubic", "cost.yaw.weight=0.5..9.0"])
    start = start_values(space, scenes, [])
    bad = Task(
        scenes=scenes,
        space=[Range("timing.timeout", 0.001, 60.0, False, False), *space[1:]],
        start={**start, "timing.timeout": 45.0},
        seeds=[10000],
        contact_penalty=5.0,
    )
    study, seen = open_study(tmp_path / "a.db", bad), []
    study.enqueue_trial({"timing.timeout": 0.01, "cost.yaw.weight": 1.0})
    search(study, bad, FakeWorkers(), trials=3, on_trial=seen.append)
    assert "shorter than control_dt" in seen[1].user_attrs["refused"]
    assert [trial.state for trial in seen] == [TrialState.COMPLETE, TrialState.PRUNED, TrialState.COMPLETE]


def test_what_was_interrupted_is_tried_again(tmp_path, task):
    study = open_study(tmp_path / "a.db", task)
    for _ in range(2):  # the start and one more
        task.space[0].suggest(study.ask())
    lost = [trial.params for trial in study.trials]
    study, seen = open_study(tmp_path / "a.db", task), []
    search(study, task, FakeWorkers(), trials=2, on_trial=seen.append)
    assert [trial.params for trial in seen] == lost
    assert seen[0].user_attrs["start"]


@pytest.fixture(scope="module")
def study_file(tmp_path_factory):
    return tmp_path_factory.mktemp("tune") / "point.db"


@pytest.fixture(scope="module")
def first_run(study_file):
    return tune(SHIPPED, "--key", *KEYS, "--trials", "2", "--episodes", "1", "--study", study_file, *TINY)


def test_a_tuning_stores_its_trials_and_prints_what_it_found(first_run, study_file):
    assert first_run.returncode == 0, first_run.stderr
    start, *_ = optuna.load_study(study_name="tune", storage=f"sqlite:///{study_file}").trials
    scene = warpmpc.load_scene(SHIPPED)
    weight = next(cost.weight for cost in scene.cost if cost.label == "reach")
    assert start.params["cost.reach.weight"] == weight
    assert start.params["planner.noise.sigma.0"] == scene.planner.noise.sigma[0]
    assert start.params["planner.spline"] == "cubic"
    for part in (
        "start  trial 0:",
        "best   trial",
        "seeds 10000 to 10000",
        "[variants.tuned]",
        "--set cost.reach.weight=",
    ):
        assert part in first_run.stdout
    overrides = [
        line.partition(" ")[2].strip("'") for line in first_run.stdout.splitlines() if line.startswith("--set")
    ]
    warpmpc.load_scene(SHIPPED, overrides=overrides)


def test_a_tuning_goes_on_where_it_stopped(first_run, study_file, capsys):
    args = [SHIPPED, "--key", *KEYS, "--episodes", "1", "--study", str(study_file), *TINY]
    assert program.main([*args, "--trials", "3"]) == 0
    err = capsys.readouterr().err
    assert "trial 2:" in err
    assert "trial 1:" not in err
    study = optuna.load_study(study_name="tune", storage=f"sqlite:///{study_file}")
    assert [trial.state.is_finished() for trial in study.trials] == [True] * 3
    assert program.main([*args, "--seed", "7"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "was made with other seeds" in err


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["point_reach", "--key", "planner.sampels=16..32"], "Did you mean 'samples'?"),
        (["point_rech", "--key", "planner.samples=16..32"], "Did you mean 'point_reach'?"),
        (["point_reach", "--key", "planner.samples=16"], "no range and no choice"),
        (["point_reach", "--key", "planner.samples=16..512", "--engine", "mujocco"], "no engine 'mujocco'"),
    ],
    ids=["key", "scene", "range", "engine"],
)
def test_a_mistake_is_one_message_and_exit_code_2(args, says, tmp_path, capsys):
    assert program.main([*args, "--study", str(tmp_path / "a.db")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert says in err
    assert not (tmp_path / "a.db").exists()


@pytest.mark.slow
def test_a_tuning_on_two_workers_improves_a_bad_start(tmp_path):
    bad = ["--set", "cost.distance.weight=0.01", "--set", "timing.timeout=4.0", "--set", "planner.samples=32"]
    args = ["--key", "cost.distance.weight=0.001..10:log", "--trials", "12", "--episodes", "3", "--jobs", "2"]
    found = tune("point_reach", *args, "--study", tmp_path / "a.db", *bad)
    assert found.returncode == 0, found.stderr
    study = optuna.load_study(study_name="tune", storage=f"sqlite:///{tmp_path / 'a.db'}")
    assert study.best_value < study.trials[0].value
