# SPDX-License-Identifier: Apache-2.0
"""Paths and clearances of Table I: what is read from runs, the table and the picture."""

import sys

import numpy as np
import pytest
from studies.paper.fabrics.episodes import Server, drive, task_of
from studies.paper.paths import METHODS, OTHERS, ROBOTS, figures, picture, read
from studies.paper.tables import TABLES

from warpmpc import Plant, load_scene

CELLS = {cell.name: cell for cell in (*TABLES["table1"].cells, *OTHERS)}


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
    lines = table["groups"][0]["rows"]
    assert table["columns"][1:] == list(METHODS.values())
    assert [line[0] for line in lines if line[0] in ROBOTS.values()] == [*ROBOTS.values()]
    assert lines[0] == ["point robot", "2/2", "2/2", "0/2", "2/2", "2/2", "2/2"]
    assert ["path [m]", "2.2", "2.2", "-", "2.2", "2.2", "2.2"] in lines
    assert ["clearance [m]", "0.1", "0.1", "-", "0.1", "0.1", "0.1"] in lines
    picture(rows, tmp_path / "paths.png")
    assert (tmp_path / "paths.png").stat().st_size > 1000


def test_a_fabric_gets_the_spheres_the_limits_and_a_model_without_capsules():
    disc, arm = (task_of(load_scene(name)) for name in ("point_reach", "panda_reach"))
    assert (len(disc["spheres"]), len(arm["spheres"])) == (5, 5)
    assert (disc["speed"], arm["speed"]) == ([2.5] * 2, [1.5] * 7)
    assert len(arm["limits"]) == 7
    assert "panda_joint7" in arm["urdf"]
    assert "<capsule" not in arm["urdf"]
    with pytest.raises(ValueError, match="not 'omni_push_box'"):
        task_of(load_scene("omni_push_box"))


def test_a_python_without_fabrics_is_named():
    with pytest.raises(ValueError, match="--fabrics /no/python"):
        Server("/no/python", {"speed": [1.0]})
    with pytest.raises(ValueError, match="pip install fabrics"):
        Server(sys.executable, {"speed": [1.0]})


def test_a_plant_is_driven_until_it_is_done():
    scene = load_scene("point_reach", overrides=["goal.position=[1.0, 2.5]"])
    record = drive(Plant(scene), lambda q, qd, nu: np.array([*(np.array([1.0, 2.5]) - q[:2]), 0.0], dtype=np.float32))
    assert record["result"]["success"]
    assert record["measured"]["path_length_m"] == pytest.approx(np.hypot(0.9, 2.5) - 0.15, abs=0.1)
