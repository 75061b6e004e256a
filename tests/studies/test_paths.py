# SPDX-License-Identifier: Apache-2.0
"""Paths and clearances of Table I: what is read from runs, the table and the picture."""

import pytest
from studies.experiments.tables import TABLES
from studies.paths import METHODS, ROBOTS, figures, picture, read

CELLS = {cell.name: cell for cell in TABLES["table1"].cells}


def record(*, success=True, path=2.2, clearance=0.1, force=0.0):
    return {
        "result": {
            "success": success,
            "time_to_goal_s": 1.0 if success else None,
            "collisions": {"max_force_N": force},
            "plan_ms": {"p50": 2.0},
        },
        "measured": {"path_length_m": path, "start_position_error_m": 2.15, "clearance_m": clearance},
    }


def test_paths_are_those_of_runs_that_reached_the_goal_and_contacts_those_of_all():
    row = read(CELLS["point_paper"], [record(), record(path=4.0, clearance=0.3), record(success=False, force=9.0)])
    assert (row["robot"], row["method"], row["runs"], row["touched"]) == ("point robot", "as in the paper", 3, 1)
    assert row["path_m"] == [2.2, 4.0]
    assert row["detour"] == pytest.approx([1.1, 2.0])  # over 2.15 m less the 0.15 m within which it counts


def test_every_method_has_a_row_and_a_box_even_where_none_arrived(tmp_path):
    assert {name.partition("_")[0] for name in CELLS} == set(ROBOTS)
    assert {name.partition("_")[2] for name in CELLS} == set(METHODS)
    rows = [read(cell, [record(success="ilqg" not in name)] * 2) for name, cell in CELLS.items()]
    table = figures(rows, {"cores": 4, "cpu": "a processor"}, "python")
    cells = table["groups"][0]["rows"]
    assert len(cells) == len(CELLS)
    assert all(len(line) == len(table["columns"]) for line in cells)
    assert cells[0][2:] == ["2 of 2", "1 ± 0", "2.2 ± 0", "1.1 ± 0", "0.1 ± 0; 0.1"]
    assert cells[list(CELLS).index("panda_ilqg")][2:] == ["0 of 2", "-", "-", "-", "-"]
    picture(rows, tmp_path / "paths.png")
    assert (tmp_path / "paths.png").stat().st_size > 1000
