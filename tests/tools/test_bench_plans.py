# SPDX-License-Identifier: Apache-2.0
"""The tools that time engines: rows of the goals, the process that measures them."""

import json

from benches import plans
from benches.goals.rows import CORE, PLAN, WARP, Row, rows_here
from benches.goals.worker import Worker
from benches.plans import told, verdict

from warpmpc import load_scene

SMALL = {"plans": 5, "floor": True, "small": True}
QUICK = Row(kind=PLAN, scene="point_reach", goal=1.0, cores=1)


def machine(cores, gpus=()):
    return {"cores": cores, "gpus": list(gpus)}


def test_a_machine_has_the_rows_that_it_can_measure():
    small, large, gpu = rows_here(machine(2)), rows_here(machine(16)), rows_here(machine(16, ["a GPU"]))
    assert {row.cores for row in small} == {1, 2}
    assert {row.cores for row in large} == {1, 2, 16}
    assert {row.cores for row in gpu} == {None, 1, 2, 16}
    assert [row.cores for row in rows_here(machine(16, ["a GPU"]), "gpu")] == [None] * (len(gpu) - len(large))
    assert rows_here(machine(16, ["a GPU"]), "cpu") == large
    assert {row.kind for row in gpu} == {PLAN, CORE, WARP}


def test_every_row_is_a_scene_that_can_be_loaded():
    for row in rows_here(machine(16, ["a GPU"])):
        if row.kind == PLAN:
            assert load_scene(row.scene, overrides=list(row.overrides)).planner.samples > 0


def test_goals_are_upper_bounds_of_times_and_lower_bounds_of_ratios():
    times, ratio = {"kind": PLAN, "goal": 2.0}, {"kind": CORE, "goal": 8.0}
    assert "met" in verdict(times | {"plan_ms": {"p50": 1.9, "p99": 3.0}})
    assert "missed by 50 %" in verdict(times | {"plan_ms": {"p50": 3.0, "p99": 3.0}})
    assert "missed by 50 %" in verdict(ratio | {"ratio": 4.0})
    assert "met" in verdict(ratio | {"ratio": 9.0})
    assert "no cables" in verdict(ratio | {"error": "no cables"})


def test_a_process_measures_a_plan_and_the_physics_alone_whatever_failed_before():
    with Worker() as worker:
        late = worker.call(QUICK, SMALL, 0.05)
        wrong = worker.call(Row(kind=PLAN, scene="no_such_scene", goal=None, cores=1), SMALL, 60.0)
        found = worker.call(QUICK, SMALL, 120.0)
    assert "longer" in late["error"]
    assert "no such scene" in wrong["error"]
    assert "error" not in found, found
    assert 0.0 < found["plan_ms"]["p50"] <= found["plan_ms"]["p99"]
    assert found["floor_ms"]["p50"] > 0.0
    assert found["other"] == "mujoco"
    assert "mujoco.rollout alone" in told(QUICK.to_json() | found | {"took_s": 1.0})


def test_results_are_written_row_by_row(tmp_path, monkeypatch):
    out = tmp_path / "out.json"
    written = []

    class Fake:
        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def call(self, row, settings, seconds):
            written.append(len(json.loads(out.read_text())["rows"]) if out.exists() else 0)
            return {"plan_ms": {"p50": 1.0, "p99": 2.0}, "plans": 5} if row.kind == PLAN else {"error": "refused"}

    monkeypatch.setattr(plans, "Worker", Fake)
    plans.main(["--on", "cpu", "--json", str(out)])
    assert written == list(range(len(written)))
    rows = json.loads(out.read_text())["rows"]
    assert len(rows) == len(written) > 0
    assert all("goal" in row and "took_s" in row for row in rows)
