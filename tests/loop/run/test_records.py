# SPDX-License-Identifier: Apache-2.0
"""Finished jobs on disk: kept at once, the same when read back, another run's where anything that matters differs."""

import dataclasses
import json
import math
from pathlib import Path

import pytest

from warpmpc import load_scene
from warpmpc.loop.run import workers as module
from warpmpc.loop.run.result import EpisodeResult
from warpmpc.loop.run.workers import FinishedJobs, KeptResults

SCENES = Path(load_scene("omni_push_box").path).parent


def a_result(seed: int = 3, **changes) -> EpisodeResult:
    values = {
        "scene": "s",
        "variant": None,
        "seed": seed,
        "engine": "mujoco",
        "device": "cpu",
        "success": True,
        "reason": "goal reached",
        "sim_time": 1.25,
        "steps": 31,
        "position_error": 0.01,
        "yaw_error": 0.2,
        "axis_error": 0.1,
        "cost": 3.5,
        "max_force": 4.0,
        "time_in_contact": 0.5,
        "plan_ms": {"p50": 1.0, "p90": 2.0, "p99": 3.0, "max": 4.0},
        "stages_ms": {"begin": 0.1, "evaluate": 0.9},
        "diverged_worlds": 2,
        "samples": 16,
        "horizon": 4,
        "fallbacks": 1,
        "envs": 2,
        "phases": (("home", 0.5),),
        "reached": 1,
        "drawn": {"goal.position": [1.0, 2.0]},
        "mean_cost": None,
        "proposers": {"samples": 0.25, "last plan": 0.75, "lowered": 0.5},
        "foresight": {"state": 0.1, "state_ahead": 0.2, "cost": 0.3},
        "verdict": ("position: 0.2 m off, 0.1 m too far",),
        "shortfall": None,
        "tried": ({"set": ["planner.samples=128"], "helped": True, "outcome": "the goal is reached at 1.20 s"},),
    }
    assert set(values) == {field.name for field in dataclasses.fields(EpisodeResult)}
    return EpisodeResult(**{**values, **changes})


def test_a_result_survives_json():
    assert EpisodeResult.from_json(a_result().to_json()) == a_result()
    plain = a_result(
        success=False, position_error=None, yaw_error=None, axis_error=None, phases=(), reached=None, drawn={}
    )
    assert EpisodeResult.from_json(plain.to_json()) == plain
    without = a_result(success=None, reason="timeout", mean_cost=2.5)
    assert EpisodeResult.from_json(without.to_json()) == without
    assert without.passed
    unknown = EpisodeResult.from_json(a_result(cost=math.inf, plan_ms={"p50": math.nan}).to_json())
    assert math.isnan(unknown.cost)
    assert math.isnan(unknown.plan_ms["p50"])


@pytest.fixture(scope="module")
def scene():
    return load_scene("omni_push_box")


def test_a_result_is_found_where_all_that_matters_is_the_same(tmp_path, scene):
    (tmp_path / "a.py").write_text("a")
    (tmp_path / "b.py").write_text("b")
    where = {"engine": "auto", "device": "cpu", "term_files": [tmp_path / "a.py"]}
    KeptResults(tmp_path / "r.jsonl", scene, **where).add([3], a_result())

    def found(scene=scene, seeds=(3,), **changes) -> list[EpisodeResult]:
        return KeptResults(tmp_path / "r.jsonl", scene, **{**where, **changes}).find(list(seeds))

    assert found() == [a_result()]
    assert not found(load_scene("omni_push_box", overrides=["planner.samples=17"]))
    assert not found(engine="mujoco")
    assert not found(device="auto")
    assert not found(term_files=[tmp_path / "b.py"])
    assert not found(seeds=[4])
    assert not found(seeds=[3, 4])


def test_episodes_planned_together_are_kept_together(tmp_path, scene):
    kept = KeptResults(tmp_path / "r.jsonl", scene, engine="auto", device="auto")
    kept.add([3, 4], a_result(3))
    assert not kept.find([3, 4])
    assert not kept.find([3])
    kept.add([3, 4], a_result(4))
    assert kept.find([3, 4]) == [a_result(3), a_result(4)]


def test_results_of_another_state_of_the_code_are_counted(tmp_path, scene, monkeypatch):
    KeptResults(tmp_path / "r.jsonl", scene, engine="auto", device="auto").add([3], a_result())
    same = KeptResults(tmp_path / "r.jsonl", scene, engine="auto", device="auto")
    monkeypatch.setattr(module, "code_digest", lambda: "later")
    later = KeptResults(tmp_path / "r.jsonl", scene, engine="auto", device="auto")
    assert (len(same.find([3])), same.outdated) == (1, 0)
    assert (len(later.find([3])), later.outdated) == (1, 1)


def test_a_result_of_another_asset_does_not_count(tmp_path, scene):
    asset = tmp_path / "robot.urdf"
    asset.write_text((SCENES / "assets" / "omni_base.urdf").read_text())
    own = load_scene("omni_push_box", overrides=[f'robot.base.asset="{asset}"'])
    KeptResults(tmp_path / "r.jsonl", own, engine="auto", device="auto").add([3], a_result())
    assert KeptResults(tmp_path / "r.jsonl", own, engine="auto", device="auto").find([3])
    asset.write_text(asset.read_text() + "\n")
    assert not KeptResults(tmp_path / "r.jsonl", own, engine="auto", device="auto").find([3])


def test_kept_jobs_survive_a_write_that_was_cut_off(tmp_path):
    records = FinishedJobs(tmp_path / "new" / "t.jsonl")
    records.add("first", {"seed": 0})
    with open(records.path, "ab") as file:
        file.write(b'{"key": "half')
    records = FinishedJobs(records.path)
    assert set(records.by_key) == {"first"}
    records.add("second", {"seed": 1})
    assert [json.loads(line)["seed"] for line in records.path.read_text().splitlines()] == [0, 1]
    assert set(FinishedJobs(records.path).by_key) == {"first", "second"}


@pytest.mark.parametrize("text", ["no JSON\n", "[1, 2]\n", '{"seed": 3}\n', "7\n"])
def test_a_file_of_something_else_is_refused_by_its_line(tmp_path, text):
    file = tmp_path / "t.jsonl"
    file.write_text('{"key": "a"}\n' + text)
    with pytest.raises(ValueError, match=r"t\.jsonl:2: is no record"):
        FinishedJobs(file)
