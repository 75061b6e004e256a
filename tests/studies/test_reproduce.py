# SPDX-License-Identifier: Apache-2.0
"""Reproducing tables: statistics, runs that are kept and never repeated, reports, and mistakes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from shared import commands
from shared.jobs import Job
from studies.experiments.metrics import METRICS, estimate, shown
from studies.experiments.report import Report, Row
from studies.experiments.runs import Run, plan_runs, spread
from studies.experiments.tables import GROUPS, TABLES, Cell, Table

import warpmpc
from warpmpc.cost.stack import CostStack
from warpmpc.model.compiled import compile_scene
from warpmpc.task.task import Task

TOOL = Path(__file__).parents[2] / "tools" / "study.py"
TINY = ["--set", "planner.samples=16", "--set", "planner.horizon=4", "--set", "timing.timeout=0.4"]


def tool(*args: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the tool as a user does."""
    command = [sys.executable, TOOL, "reproduce", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8", timeout=280)


def record(*, success=True, time=10.0, force=0.0, **more) -> dict:
    """A run's record, as far as the tables need it."""
    return {
        "result": {
            "success": success,
            "reason": "goal reached" if success else "timeout",
            "time_to_goal_s": time if success else None,
            "final": {"position_error_m": 0.03, "yaw_error_rad": 0.2},
            "collisions": {"max_force_N": force},
            "plan_ms": {"p50": 30.0},
        },
        "measured": {"path_length_m": 4.0, "clearance_m": None, "axes_error_m": [0.02, -0.01]},
        "gpu": None,
        "jobs": 1,
        "code": "now",
        "cpu": "a processor",
        "cores": 4,
        **more,
    }


def test_metrics_of_records():
    runs = [record(time=8.0), record(time=12.0, force=3.0), record(success=False)]
    assert estimate(METRICS["success"], runs).value == pytest.approx(2 / 3)
    assert estimate(METRICS["free"], runs).value == pytest.approx(2 / 3)
    assert estimate(METRICS["time"], runs).value == 10.0
    assert estimate(METRICS["time"], runs).count == estimate(METRICS["path"], runs).count == 2
    assert estimate(METRICS["cost"], runs).value == pytest.approx(1.5 * 0.03 + 0.01 * 0.2)
    assert estimate(METRICS["clearance"], runs) is None
    assert shown(METRICS["time"], estimate(METRICS["time"], runs)) == "10.00 ± 25.41"
    assert shown(METRICS["time"], estimate(METRICS["time"], runs[:1])) == "8.00"
    assert shown(METRICS["clearance"], None) == "–"


CELL = Cell(name="one", title="first cell", scenes=("some:A",), paper={"success": (0.9,), "time": (9.66, 0.84)})


def report(*records: dict) -> Report:
    """A report of one cell with these runs, seeds 0 and up."""
    job = {"scene": "some:A", "overrides": ("planner.samples=9",)}
    runs = [
        (Run(table="t", cell="one", job=Job(**job, seed=seed), scene_hash="x"), record)
        for seed, record in enumerate(records)
    ]
    table = Table(title="A table", metrics=("success", "free", "time"), runs=3, cells=(CELL,), note="A note.")
    return Report("t", table, [Row(CELL, runs)], "the command", {"python": "3"}, "2026-01-01", "now")


def test_the_page_has_figures_failures_with_seeds_and_commands():
    bad = record(success=False)
    page = report(record(time=8.0), bad, record(time=12.0, force=3.0), bad).markdown()
    assert "| first cell | 4 | 50 % [15, 85] | 75 % [30, 95] | 10.00 ± 25.41 |" in page
    assert "| *paper* |  | *90 %* |  | *9.66 ± 0.84* |" in page
    assert "2 × timeout: seeds 1, 3. One alone: `warpmpc run some:A --seed 1 --set planner.samples=9`" in page
    assert "1 × collision: seed 2." in page
    for part in ("the command", "2026-01-01", "4 cores of a processor", "python 3", "A note."):
        assert part in page
    assert "No failures." in report(record()).markdown()


def test_the_page_owns_up_to_crowded_and_outdated_runs():
    page = report(record(jobs=8), record(code="before")).markdown()
    assert "8 at a time" in page
    assert "1 of these 2 runs were made by another state of the code" in page


def test_the_data_names_failed_runs():
    cell = report(record(), record(success=False)).to_json()["cells"][0]
    assert [(run["scene"], run["seed"]) for run in cell["failures"]["timeout"]] == [("some:A", 1)]
    assert cell["ours"]["success"]["count"] == 2


def runs_of(cell: Cell, **changes) -> list[Run]:
    options = {"seeds": range(2), "overrides": [], "engine": "auto", "device": "auto", **changes}
    return plan_runs("t", [cell], **options)


def test_a_run_is_another_one_when_anything_that_matters_differs():
    cell = Cell(name="p", title="", scenes=("omni_push_box:A",))
    base = {run.key for run in runs_of(cell)}
    assert base == {run.key for run in runs_of(cell)}
    for other in (
        runs_of(cell, overrides=["planner.samples=17"]),
        runs_of(cell, engine="mujoco"),
        runs_of(cell, seeds=range(5, 7)),
        runs_of(Cell(name="p", title="", scenes=("omni_push_box:B",))),
        runs_of(Cell(name="q", title="", scenes=("omni_push_box:A",))),
    ):
        assert len(other) == 2
        assert not base & {run.key for run in other}


def test_a_star_skips_entries_without_the_key():
    scene = warpmpc.load_scene("omni_push_box")
    texts = spread(scene, ["cost.*.inflation=0.3", "planner.samples=9"])
    assert {"cost.reach.inflation=0.3", "cost.push_path.inflation=0.3", "planner.samples=9"} <= set(texts)
    assert not any(text.startswith("cost.yaw") for text in texts)
    with pytest.raises(ValueError, match="no entry of omni_push_box has this key"):
        spread(scene, ["cost.*.nonsense=1"])


def exists(source: str) -> bool:
    try:
        warpmpc.load_scene(source)
    except warpmpc.SceneError:
        return False
    return True


@pytest.mark.parametrize(("table", "cell"), [(name, cell) for name, table in TABLES.items() for cell in table.cells])
def test_every_cell_fits_its_scenes(table, cell):
    if missing := [name for name in cell.scenes if not exists(name)]:
        pytest.skip(f"no scene {missing[0]}")
    assert len(runs_of(cell)) == 2 * len(cell.scenes)
    assert set(cell.paper) <= set(TABLES[table].metrics) <= set(METRICS)


@pytest.mark.parametrize("name", ["A_geodesic", "A_terms"])
def test_the_papers_own_terms_are_terms_with_known_keys(name):
    (cell,) = (cell for cell in TABLES["ablations"].cells if cell.name == name)
    scene = warpmpc.load_scene(
        cell.scenes[0], overrides=list(spread(warpmpc.load_scene(cell.scenes[0]), cell.overrides))
    )
    stack = CostStack(scene, compile_scene(scene).layout, Task(scene))
    assert list(stack.labels) == ["distance", "bring", "yaw", "push_alignment", "base_contact", "box_contact"]


def test_finished_runs_are_never_repeated(tmp_path, capsys):
    args = ["table4/box_A", *TINY, "--out", str(tmp_path)]
    first = tool(*args, "--runs", "2")
    assert first.returncode == 0, first.stderr
    assert "paper 9.66 ± 0.84" in first.stdout
    lines = (tmp_path / "table4.jsonl").read_text().splitlines()
    assert [json.loads(line)["seed"] for line in lines] == [0, 1]
    assert commands.run("studies", "", ["reproduce", *args, "--runs", "3"]) == 0
    assert "1/1" in capsys.readouterr().err
    assert (tmp_path / "table4.jsonl").read_text().splitlines()[:2] == lines
    page = (tmp_path / "table4.md").read_text()
    assert "3 × timeout: seeds 0, 1, 2. One alone: `warpmpc run omni_push_box:A --seed 0 --set planner" in page
    (cell,) = json.loads((tmp_path / "table4.json").read_text())["cells"]
    assert (cell["runs"], cell["ours"]["success"]["value"]) == (3, 0.0)
    assert commands.run("studies", "", ["reproduce", *args, "--runs", "3"]) == 0  # nothing left to do
    assert "0/0" in capsys.readouterr().err
    assert len((tmp_path / "table4.jsonl").read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["tabel4"], "no such table: 'tabel4'; there is: table1, table2"),
        (["table4/box_C"], "no such cell of table4: 'box_C'; there is: box_A"),
        (["ghost/walks"], "ghost/walks: no_scene_at_all: no such scene file"),
        (["table1/point", "--set", "planner.sampels=3"], "Did you mean 'samples'?"),
        (["table1/point", "--set", "cost.*.nonsense=3"], "no entry of point_reach has this key"),
        (["table1/point", "--engine", "mujocco"], "no engine 'mujocco'"),
    ],
    ids=["table", "cell", "scene", "override", "star", "engine"],
)
def test_a_mistake_is_one_message_and_exit_code_2(args, says, tmp_path, monkeypatch, capsys):
    ghost = Cell(name="walks", title="", scenes=("no_scene_at_all",))
    monkeypatch.setitem(TABLES, "ghost", Table(title="", metrics=("success",), runs=1, cells=(ghost,)))
    assert commands.run("studies", "", ["reproduce", *args, "--out", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert says in err
    assert not list(tmp_path.iterdir())


def test_every_row_as_in_the_paper_is_the_scene_of_ours_with_the_papers_planner():
    papers = [cell for name in GROUPS["pezzato"] for cell in TABLES[name].cells if cell.name.endswith("_paper")]
    assert {scene.partition(":")[0] for cell in papers for scene in cell.scenes} == {
        "point_reach", "panda_reach", "panda_push", "panda_push_objects", "omni_push_box", "omni_push_sphere",
        "diff_push_box", "mobile_pick",
    }  # fmt: skip
    for source in (scene for cell in papers for scene in cell.scenes):
        paper, name = warpmpc.load_scene(source), source.removesuffix("paper").rstrip(":+")
        ours, planner = warpmpc.load_scene(name), paper.planner
        assert (paper.goal, paper.success, paper.robot, paper.object) == (
            ours.goal,
            ours.success,
            ours.robot,
            ours.object,
        )
        assert (planner.method, planner.dt, planner.knots, planner.iterations) == ("mppi", (0.04,), "steps", 1)
        assert planner.noise.sigma != ours.planner.noise.sigma


@pytest.mark.parametrize("cell", [cell for cell in TABLES["mjpc"].cells if cell.name.endswith("_paper")])
def test_rows_of_mujoco_mpc_are_algorithm_4_at_its_rate_for_ours_success(cell):
    (source,) = cell.scenes
    paper, ours = warpmpc.load_scene(source), warpmpc.load_scene(source.removesuffix(":paper"))
    planner, noise = paper.planner, paper.planner.noise
    assert (planner.method, planner.samples, planner.iterations) == ("predictive_sampling", 10, 1)
    assert (noise.source, noise.shape, noise.spread, noise.constant) == ("random", "identity", (1.0, 1.0), 0.0)
    assert (noise.null_sample, planner.keep_best, planner.discount) == (False, 0, 1.0)
    assert paper.timing.control_dt <= 0.002, "500 to 1000 plans in a second of simulated time"
    assert (paper.success, paper.goal, paper.timing.timeout) == (ours.success, ours.goal, ours.timing.timeout)
