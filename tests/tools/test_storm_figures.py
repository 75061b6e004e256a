# SPDX-License-Identifier: Apache-2.0
"""STORM's figures: rows of their tables from runs, pictures, and the page that is made of them.

Slow ones by hand: pytest -m slow tests/tools/test_storm_figures.py
"""

import runpy
from argparse import Namespace

import numpy as np
import pytest
from pages import ROOT
from studies.arms import balance, track
from studies.arms.report import FIGURES, figures
from studies.arms.runs import run_pose


def ball(*away: float) -> balance.Run:
    """A run of 10 s whose ball is so far from the centre after 5 s [m]."""
    path = np.zeros((500, 3))
    path[0, 0], path[250 : 250 + len(away), 0] = 0.1, away
    return balance.Run(seed=0, path=path, dt=0.02, hand=np.zeros(499))


def test_a_balanced_ball_counts_by_how_far_it_is_after_it_settled():
    row = balance.figures(Namespace(model="paper", scene="storm_balance"), [ball(0.01), ball(0.03), ball(0.05)])
    assert row == ["(Rᵀg)_xy, the paper's", "`storm_balance`", "1 of 3", "2 of 3", "10 to 50, median 30"]
    lost = ball(0.01)
    lost.path[-1, 2] = -0.1
    assert balance.figures(Namespace(model="ours", scene="s"), [lost])[2:] == ["0 of 1", "0 of 1", "-"]


def test_balls_are_drawn(tmp_path):
    np.savez(tmp_path / "storm_balance_ours.npz", paths=[ball(0.01).path], dt=0.02)
    balance.draw(tmp_path, "storm_balance", tmp_path / "balls.png")
    assert (tmp_path / "balls.png").stat().st_size > 1000


def test_waits_of_the_ball_have_a_row_each():
    stop = {"place": (0.7, 0.25, 0.2), "came_m": 0.11, "nearest_m": 0.1, "back_s": None}
    run = {
        "scene": "storm_track:walls",
        "error_m": [0.01, 0.02, 0.05],
        "rotation_percent": [0.0, 0.0],
        "rotation_rad": [0.0, 0.0],
        "oriented": False,
        "force_N": 0.0,
        "own_links": [],
        "clearance_m": 0.012,
        "jerk_rms": 9.0,
        "stops": [stop],
    }
    errors, waits = track.figures([run, {**run, "force_N": 3.0, "stops": [{**stop, "came_m": 0.13, "back_s": 0.5}]}])
    assert errors == [["`storm_track:walls`", "10.0, 20.0, 50.0", "free", "1 of 2", "12.0"]]
    assert waits == [["(0.7, 0.25, 0.2)", "120, 130", "100", "0.50, 0.50", "1"]]


@pytest.mark.slow
def test_operational_space_control_comes_to_a_pose_in_less_time_than_the_planner():
    record = run_pose("osc", "storm_reach", ("engine.threads=1",), 10000, 0.02)
    assert record["reached"]
    assert record["time_s"] < 2.0
    row = figures("OSC", [record])
    assert len(row) == len(FIGURES)
    assert row[:2] == ["OSC", "1 of 1"]


def test_a_page_is_made_of_titles_sentences_tables_and_pictures():
    section = {"title": "A part", "data": ["reach"], "picture": {"a.png": "A"}}
    page = runpy.run_path(str(ROOT / "tools" / "pages" / "figures.py"))
    text = page["assembled"]({"title": "A page", "text": "Words.", "section": [section]})
    assert text == "# A page\n\nWords.\n\n## A part\n\n<!-- data: reach -->\n<!-- end -->\n\n![A](a.png)\n"
    assert "|`storm_reach`|" in page["rewritten"](text)


def test_a_cell_has_the_figure_of_another_file():
    page = runpy.run_path(str(ROOT / "tools" / "pages" / "figures.py"))
    rows = [["{wrong_model|quadruped_walk|as planned} s", "{control_suite}"]]
    text = page["table"]({"columns": ["time", "suite"], "groups": [{"rows": rows}]})
    assert text.splitlines()[2].startswith("|3.9 s|12 of 16 at 800 or more")
    for bad in ("{wrong_model|nothing|as planned}", "{wrong_model|quadruped_walk|nothing}", "{nothing|a|b}"):
        with pytest.raises(ValueError, match=r"wrong_model|nothing"):
            page["table"]({"columns": ["time"], "groups": [{"rows": [[bad]]}]})
