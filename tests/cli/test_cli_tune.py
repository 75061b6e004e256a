# SPDX-License-Identifier: Apache-2.0
"""``warpmpc tune``: a planted bad σ is found, studies go on, Ctrl-C keeps the best, mistakes are one message.

Slow ones by hand: pytest -m slow tests/cli/test_cli_tune.py
"""

import importlib.util
import os
import re

import pytest
from program import small_disk

import warpmpc
from warpmpc.cli import tune as module
from warpmpc.extras.tuning.search import Outcome

optuna = pytest.importorskip("optuna", reason="tuning needs optuna")
SET = ["--set", "timing.timeout=4.0"]
KEYS = [
    "--key", "cost.reach.weight=0.1..6:log", "--key", "planner.knots=2..4",
    "--key", "planner.noise.sigma[0]=0.3..2", "--key", "planner.spline=linear|cubic",
]  # fmt: skip
TINY = ["--set", "planner.samples=16", "--set", "planner.horizon=4", "--set", "timing.timeout=0.4"]
TINY += ["--set", "planner.noise.sigma=[0.4, 0.4, 0.7]", "--engine", "mujoco"]


BAD = """
[[robot]]
name = "base"
asset = "point_robot.urdf"
ground_contact = false
frames.centre = { link = "base_link" }
drive = { damping = 300.0, effort_limit = 200.0, limit = [1.0, 1.0, 1.0] }

[timing]
timeout = 5.0

[goal]
frame = "base/centre"
position = [1.0, 0.5]

[[cost]]
term = "distance"
between = ["base/centre", "goal"]

[planner]
samples = 32
horizon = 6
noise.sigma = [0.004, 0.004, 0.004]  # planted: far too small to move the robot
refine = false

[success]
distance = 0.1
"""


@pytest.fixture
def bad_scene(tmp_path):
    file = tmp_path / "bad.toml"
    file.write_text(BAD)
    return file


def test_a_planted_bad_sigma_is_found_and_written(command, bad_scene):
    before = warpmpc.load_scene(str(bad_scene)).planner.noise.sigma
    key = ["--key", "planner.noise.sigma=x0.5..300"]
    done = command("tune", str(bad_scene), *key, "--trials", "8", "--episodes", "1", "-o", "good.toml", *SET)
    assert done.returncode == 0, done.stderr
    start, best = (
        float(re.search(rf"^{name} +trial \d+: (\S+) s", done.stdout, re.M)[1]) for name in ("start", "best")
    )
    assert best < 4.0 < 8.0 <= start  # reached within the timeout, which the start does not
    assert "-noise.sigma = [0.004, 0.004, 0.004]  # planted" in done.stdout
    tuned = warpmpc.load_scene("good.toml")
    assert tuned.planner.noise.sigma[0] > 10.0 * before[0]
    assert tuned.timing.timeout == warpmpc.load_scene(str(bad_scene)).timing.timeout  # what --set says is not written


SIGMA = ["--key", "planner.noise.sigma=x0.5..300"]


@pytest.mark.parametrize("passes", ["fewer", "none", "more"])
def test_only_values_that_pass_as_often_are_written(command, bad_scene, monkeypatch, passes):
    tried = []

    def outcome(arguments, changes, seed, penalty):
        tried.append(changes)
        start = changes == tried[0]
        return Outcome(9.0 if start else 8.0, {"fewer": start, "none": False, "more": seed == 0 or not start}[passes])

    monkeypatch.setattr(module, "run_trial", outcome)
    done = command("tune", str(bad_scene), *SIGMA, "--trials", "2", "--episodes", "2", "-o", "good.toml", *SET)
    assert done.returncode == 0, done.stderr
    assert os.path.exists("good.toml") == (passes != "fewer")
    said = {
        "fewer": "no trial was better than the scene's own values and passed as often",
        "none": "wrote good.toml: 0 of 2 passed, 0 of 2 before",
        "more": "wrote good.toml: 2 of 2 passed, 1 of 2 before",
    }
    assert said[passes] in done.stdout
    assert ("warning: no episode passed" in done.stderr) == (passes == "none")


@pytest.mark.parametrize("file", ["good.toml", "a.db", "new.db"])
def test_a_full_disk_ends_a_tuning_in_one_line(command, bad_scene, monkeypatch, file):
    values = iter(range(100, 0, -1))
    monkeypatch.setattr(module, "run_trial", lambda *args: Outcome(float(next(values)), True))
    args = ["tune", str(bad_scene), *SIGMA, "--episodes", "1", *SET]
    size = 1000
    if file == "good.toml":
        args += ["-o", file]
        bad_scene.write_text(BAD + "#" * 300_000)
        size = 290_000  # what is compiled is smaller
        assert command(*args, "--trials", "1").returncode == 0
    else:
        args += ["--study", file]
        if file == "a.db":
            assert command(*args, "--trials", "1").returncode == 0
            size = os.path.getsize(file)
    with small_disk(size):
        done = command(*args, "--trials", "60")
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith(("trial", "--key"))]
    assert line.startswith(f"error: cannot write '{file}': ")
    assert ("best   trial" in done.stdout) == (file != "new.db")


def test_a_scene_alone_is_enough(command):
    done = command("tune", "omni_push_box", "--trials", "2", "--episodes", "1", *TINY)
    assert done.returncode == 0, done.stderr
    for key in ("cost.reach.weight=", "planner.noise.sigma=x", "planner.horizon=", "planner.temperature.ess="):
        assert f"--key {key}" in done.stderr
    assert "trial 1:" in done.stderr
    assert "seeds 0 to 0: report other seeds" in done.stdout


def test_a_tuning_goes_on_where_it_stopped(command, tmp_path):
    args = ["tune", "omni_push_box", *KEYS, "--episodes", "1", "--study", str(tmp_path / "a.db"), *TINY]
    assert command(*args, "--trials", "2").returncode == 0
    study = optuna.load_study(study_name="tune", storage=f"sqlite:///{tmp_path / 'a.db'}")
    assert study.trials[0].params["planner.noise.sigma.0"] == 0.4
    assert study.trials[0].params["planner.spline"] == "cubic"
    again = command(*args, "--trials", "3")
    assert again.returncode == 0
    assert "trial 2:" in again.stderr
    assert "trial 1:" not in again.stderr
    other = command(*args, "--seed", "7")
    assert other.returncode == 2
    assert "was made with other seeds" in other.stderr


def test_ctrl_c_keeps_the_best_so_far(command, monkeypatch):
    run, calls = module.run_trial, []

    def interrupted(*args):
        calls.append(args)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return run(*args)

    monkeypatch.setattr(module, "run_trial", interrupted)
    done = command("tune", "omni_push_box", *KEYS, "--episodes", "1", *TINY)
    assert done.returncode == 130
    assert "best   trial" in done.stdout
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["point_reach", "--key", "planner.sampels=16..32"], "Did you mean 'samples'?"),
        (["point_rech", "--key", "planner.samples=16..32"], "Did you mean 'point_reach'?"),
        (["point_reach", "--key", "planner.samples=16"], "no range and no choice"),
        (["point_reach", "--engine", "mujocco"], "no engine 'mujocco'"),
        (["point_reach", "--jobs", "none"], "--jobs must be"),
        (["point_reach", "--seed", "998"], "tuning has seeds 0 to 999"),
        (["point_reach", "omni_push_box", "-o", "x.toml"], "stand in several files"),
        (["point_reach", "-o", "nowhere/x.toml"], "cannot write 'nowhere/x.toml'"),
    ],
    ids=["key", "scene", "range", "engine", "jobs", "seeds", "files", "folder"],
)
def test_a_mistake_is_one_message_and_exit_code_2(args, says, tmp_path, command):
    done = command("tune", *args, "--study", str(tmp_path / "a.db"))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert not (tmp_path / "a.db").exists()


def test_without_optuna_the_extra_is_named(command, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "optuna" else found(name, *a))
    done = command("tune", "point_reach")
    assert (done.returncode, done.stderr) == (2, 'error: tuning needs optuna: pip install "warpmpc[tune]"\n')


@pytest.mark.slow
def test_a_tuning_on_two_workers_improves_a_bad_start(command, tmp_path):
    bad = ["--set", "cost.distance.weight=0.01", "--set", "timing.timeout=4.0", "--set", "planner.samples=32"]
    args = ["--key", "cost.distance.weight=0.001..10:log", "--trials", "12", "--episodes", "3", "--jobs", "2"]
    done = command("tune", "point_reach", *args, "--study", str(tmp_path / "a.db"), *bad)
    assert done.returncode == 0, done.stderr
    study = optuna.load_study(study_name="tune", storage=f"sqlite:///{tmp_path / 'a.db'}")
    assert study.best_value < study.trials[0].value
