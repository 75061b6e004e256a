# SPDX-License-Identifier: Apache-2.0
"""Strategies compared at equal wall-clock: how many samples a time is worth, and what the tables say."""

import json
from dataclasses import replace

import pytest
from studies import planners
from studies.equal_time.cells import FEWEST, MOST, SIZE, STRATEGIES, Cell, count_for, run
from studies.equal_time.tables import summary, tables

import warpmpc
from warpmpc.run.records import Records
from warpmpc.scene.schema_planner import DIRECT


@pytest.mark.parametrize(("overhead", "each", "expected"), [(1e-3, 1e-5, 400), (0.0, 1e-4, 48), (4e-3, 1e-6, 1008)])
def test_samples_are_as_many_as_the_time_is_worth(overhead, each, expected):
    assert count_for(lambda samples: overhead + each * samples, 5e-3) == expected


def test_samples_stay_within_their_bounds():
    assert count_for(lambda samples: 1.0, 5e-3) == FEWEST
    assert count_for(lambda samples: 1e-9 * samples, 5e-3) == MOST


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("task", ["pendulum", "acrobot"])
def test_every_strategy_is_a_setting_that_the_tasks_take(strategy, task):
    planner = Cell(task=task, strategy=strategy, ms=5.0, samples=48).scene.planner
    own = warpmpc.load_scene(task).planner
    size = planner.refine.iterations if strategy in SIZE else planner.samples
    assert size == 48
    assert planner.horizon == own.horizon
    if planner.method not in DIRECT:
        assert (planner.knots, planner.spline) == (own.knots, own.spline)
    assert planner.noise.sigma == own.noise.sigma
    assert planner.method == (own.method if strategy == "shipped" else strategy)


def test_an_episode_goes_on_to_its_end_and_costs_what_the_plant_does():
    cell = Cell(task="pendulum", strategy="icem", ms=5.0, samples=24, seed=3, seconds=0.4)
    first, again = run(cell), run(cell)
    assert (first["cost"], first["reached"]) == (again["cost"], None)
    # the pendulum hangs: its tip is nearly twice its length, 0.5 m, below where it should be
    assert 0.1 < first["cost"] < 1.1
    assert run(replace(cell, seed=4))["cost"] != first["cost"]


def record(records: Records, cell: Cell, **found) -> None:
    records.add(cell.key("run"), {"cost": 1.0, "reached": None, "plan_ms": 5.0, **found})


def test_tables_have_means_with_intervals_and_tell_what_is_missing(tmp_path):
    records, cells = Records(tmp_path / "planners.jsonl"), []
    for strategy, costs in (("mppi", [2.0, 4.0, None]), ("cem", [1.0, 2.0])):
        for seed, cost in enumerate(costs):
            cells.append(Cell(task="pendulum", strategy=strategy, ms=5.0, samples=64, seed=seed, seconds=1.0))
            record(records, cells[-1], cost=cost, reached=0.5 if seed == 0 else None)
    cells.append(replace(cells[-1], seed=2))  # not made yet
    rows = summary(cells, Records(tmp_path / "planners.jsonl"))
    assert [(row["strategy"], row["seeds"], row["diverged"]) for row in rows] == [("mppi", 3, 1), ("cem", 2, 0)]
    text = tables(rows, ms=5.0, seconds=1.0)
    assert "| `pendulum` | 3 ± 13 | **1.5 ± 6.4** |" in text
    assert "| `pendulum` | 33 % [6, 79] | 50 % [9, 91] |" in text
    assert "| `pendulum` | 64, 5.0 ms | 64, 5.0 ms |" in text
    assert "Fewer seeds: pendulum, cem: 2." in text
    assert "Diverged: pendulum, mppi: 1." in text


@pytest.mark.slow
def test_the_command_stops_in_time_keeps_what_is_done_and_goes_on(tmp_path, capfd):
    command = ["--tasks", "pendulum", "--strategies", "mppi", "icem", "--runs", "2", "--seconds", "0.2", "--ms", "2"]
    command += ["--out", str(tmp_path)]
    assert planners.main([*command, "--limit", "0.5"]) == 1
    assert planners.main(command) == 0
    done = (tmp_path / "planners.jsonl").read_text()
    assert planners.main(command) == 0
    assert (tmp_path / "planners.jsonl").read_text() == done  # nothing was run again
    rows = json.loads((tmp_path / "planners.json").read_text())["rows"]
    assert [(row["strategy"], row["seeds"]) for row in rows] == [("mppi", 2), ("icem", 2)]
    assert "| `pendulum` |" in capfd.readouterr().out
