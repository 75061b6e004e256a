# SPDX-License-Identifier: Apache-2.0
"""``warpmpc run --real-time``: what it reports, and what it refuses."""

import json
import sys

import numpy as np
import pytest
from program import SCENE, results

from warpmpc import RunLog


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "push.toml"
    path.write_text(SCENE, encoding="utf-8")
    return path


def test_an_episode_in_real_time_is_reported_with_its_rates(scene, command, monkeypatch):
    # slowed down, and with patience: tests share their cores with others
    slow = ["--speed", "0.1", "--set", "timing.timeout=0.2", "--set", "agent.plan_timeout=0.3", "--engine", "mujoco"]
    out = ["--set", "engine.threads=1", "--json", "--out", str(scene.parent / "run")]
    monkeypatch.setattr("sys.argv", ["warpmpc", "run", str(scene), "--real-time", *slow, *out])
    done = command(*sys.argv[1:])
    assert done.returncode == 1, done.stderr
    assert done.stderr == ""
    (result,) = results(done)
    assert (result["success"], result["reason"], result["speed"]) == (False, "timeout", 0.1)
    assert result["ticks"] == pytest.approx(100, abs=2)
    assert result["wall_time_s"] >= 1.9
    assert result["plans"] > 3
    assert result["plan_rate_Hz"] == pytest.approx(result["plans"] / result["wall_time_s"], rel=1e-3)
    assert 0.0 < result["latency_ms"]["p50"] <= result["latency_ms"]["max"]
    assert result["jitter_ms"]["p50"] < 20.0
    assert result["faults"] == []

    folder = scene.parent / "run"
    about = json.loads((folder / "run.json").read_text())
    assert about["command"].startswith(f"warpmpc run {scene} --real-time")
    assert json.loads((folder / "results.jsonl").read_text()) == result
    assert (folder / "recording.rrd").stat().st_size > 10_000
    log = RunLog.load(folder / "episode.runlog")
    assert log.controls.following.sum() > 50
    assert np.nanmin(log.controls.age) > 0.0
    assert np.diff(log.states.time) == pytest.approx(np.full(result["ticks"], 0.002))
    assert log.names["terms"] == ["distance"]
    assert np.isfinite(log.of_plans("cost")[log.controls.plan >= 0]).all()
    replayed = command("replay", str(folder))
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
    plans = len(log.plans)
    assert f"{plans} of {plans} plans and {result['ticks']} of {result['ticks']} commands agree" in replayed.stdout
    plotted = command("plot", str(folder))
    assert plotted.returncode == 0, plotted.stderr
    assert (folder / "plots" / "ticks.png").exists()


def test_a_run_that_fails_in_real_time_says_so_and_what_it_would_need(scene, command):
    slow = ["--speed", "0.5", "--engine", "mujoco", "--set", "planner.samples=1500", "--set", "planner.horizon=20"]
    failure = ["--set", "failure=[{name='stuck', after=0.3}]", "--set", "engine.threads=1"]
    done = command("run", str(scene), "--real-time", *slow, *failure)
    assert done.returncode == 1, done.stderr
    assert done.stdout.startswith("seed 0: failed: stuck at 0.30 s")
    assert "would need" in done.stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--real-time", "--envs", "4"], "--envs: not with --real-time"),
        (["--real-time", "--results", "run.jsonl", "--jobs", "2"], "--jobs, --results: not with --real-time"),
        (["--speed", "0.5"], "goes with --real-time"),
        (["--real-time", "--speed", "2"], "should be less than or equal to 1"),
    ],
)
def test_what_does_not_go_with_real_time_is_refused(scene, command, options, message):
    done = command("run", str(scene), *options)
    assert done.returncode == 2
    assert message in " ".join(done.stderr.split())


def test_point_clouds_are_refused_by_their_key(command):
    done = command("run", "storm_cloud", "--real-time")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("error: ")
    assert "cloud: point clouds do not travel between processes yet" in done.stderr
