# SPDX-License-Identifier: Apache-2.0
"""A scene without ``[success]`` runs to its timeout and has a cost, whatever runs it."""

import json

import numpy as np
import pytest
from program import SCENE, TINY, results

import warpmpc
from warpmpc.cli.report import summary

NOTHING = SCENE.replace("[success]\nposition = 0.05\n", "")
RUN = ["run", "mine.toml", "--engine", "mujoco", *TINY]


@pytest.fixture
def scene(tmp_path):
    assert "[success]" not in NOTHING
    (tmp_path / "mine.toml").write_text(NOTHING)
    return warpmpc.load_scene(tmp_path / "mine.toml", overrides=TINY[1::2])


def test_a_run_ends_at_its_timeout_and_tells_its_cost(scene, command, tmp_path):
    done = command(*RUN, "--json", "--npz", "a.npz")
    (result,) = results(done)
    assert (done.returncode, done.stderr) == (0, "")
    assert (result["success"], result["reason"], result["steps"]) == (None, "timeout", 10)
    assert result["final"]["position_error_m"] > 0.5  # the goal is there all the same

    plant, costs = warpmpc.Plant(scene, watch=scene.cost_labels), []
    for control in warpmpc.RunLog.load(tmp_path / "a.npz").controls.control:
        plant.apply(control)
        costs.append(plant.terms["distance"])
    assert result["mean_cost"] == pytest.approx(np.mean(costs), rel=1e-6)

    table = command(*RUN, "--episodes", "2")
    assert (table.returncode, table.stderr) == (0, "")
    row = next(line.split() for line in table.stdout.splitlines() if " timeout " in line)
    assert row[:4] == ["0", "timeout", "0.40", f"{result['mean_cost']:.4g}"]
    assert "2 of 2 ran to the timeout; mean cost " in table.stdout
    assert "reached the goal" not in table.stdout


def test_environments_and_processes_tell_it_too(scene, command):
    alone = [result["mean_cost"] for result in results(command(*RUN, "--json", "--episodes", "2"))]
    spread = command(*RUN, "--json", "--episodes", "2", "--jobs", "2", "--results", "r.jsonl")
    assert (spread.returncode, spread.stderr) == (0, "")
    assert sorted(result["mean_cost"] for result in results(spread)) == sorted(alone)
    kept = command(*RUN, "--json", "--episodes", "2", "--results", "r.jsonl")
    assert sorted(result["mean_cost"] for result in results(kept)) == sorted(alone)
    together = command(*RUN, "--json", "--episodes", "2", "--envs", "2")
    assert (together.returncode, together.stderr) == (0, "")
    assert [result["success"] for result in results(together)] == [None, None]
    assert results(together)[0]["mean_cost"] == alone[0]
    assert "mean cost" in command(*RUN, "--episodes", "2", "--envs", "2").stdout


def test_real_time_tells_it_too(scene, command, tmp_path):
    slow = ["--real-time", "--speed", "0.2", "--set", "agent.plan_timeout=0.3", "--set", "engine.threads=1"]
    done = command(*RUN, *slow, "--out", "a")
    result = json.loads((tmp_path / "a" / "results.jsonl").read_text())
    assert (done.returncode, result["success"], result["reason"]) == (0, None, "timeout")
    assert 0.5 < result["mean_cost"] < 1.5  # [m], the distance that is paid for
    assert f", mean cost {result['mean_cost']:.4g}" in done.stdout


def test_what_fails_still_fails_and_check_says_what_ends_a_run(scene, command):
    done = command(*RUN, "--json", "--set", "failure=[{name='stuck', after=0.2}]")
    (result,) = results(done)
    assert (done.returncode, result["success"], result["reason"]) == (1, None, "failed: stuck")
    assert "the run goes on for 0.4 s and has a cost" in command("check", *RUN[1:]).stdout
    off = command("run", "omni_push_box", "--json", "--engine", "mujoco", *TINY, "--set", "success=false")
    assert (off.returncode, results(off)[0]["success"]) == (0, None)


def test_a_page_shows_it_to_its_end(scene):
    from warpmpc.extras.live.session import Session

    session = Session(str(scene.path), overrides=TINY[1::2], engine="mujoco")
    while not session.plant.done:
        session.plant.apply(session.controller.step(session.plant.observe()))
    assert (session.plant.reason, session.plant.success) == ("timeout", False)


def test_costs_without_a_number_are_left_out_of_the_mean(scene):
    good, bad = (warpmpc.run_episode(scene, engine="mujoco") for _ in range(2))
    bad = type(bad)(**{**vars(bad), "mean_cost": float("nan"), "reason": "the plant's physics diverged"})
    assert summary([good, bad]) == f"1 of 2 ran to the timeout; mean cost {good.mean_cost:.4g}"
