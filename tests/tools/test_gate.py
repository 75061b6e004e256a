# SPDX-License-Identifier: Apache-2.0
"""A record of commands: what moves a number or the source behind it is told, and nothing else is."""

from dataclasses import replace

import gate
import numpy as np
import pytest
import warp as wp


@pytest.fixture(scope="module")
def cell():
    return gate.Cell("pendulum", "fused", ("planner.samples=16",))


@pytest.fixture(scope="module")
def run(cell):
    return gate.play(cell)


@pytest.fixture
def before(cell, run, tmp_path):
    """The record of the cell, written and read."""
    gate.write({str(cell): run}, tmp_path / "before.npz")
    return gate.read(tmp_path / "before.npz")


def test_every_engine_and_every_shipped_scene_has_a_cell():
    import warpmpc

    cells = list(gate.cells())
    assert {cell.engine for cell in cells} == {"fused", "kinematic", "mujoco", "mujoco_warp", "newton"}
    assert {cell.scene for cell in cells} >= set(warpmpc.shipped_scenes())
    assert len({str(cell) for cell in cells}) == len(cells)


def test_a_cell_run_again_is_the_same(cell, before, capsys):
    assert gate.compare({str(cell): gate.play(cell)}, before, whole=True) == 0
    assert capsys.readouterr().out.startswith("1 of 1 cells are bit-identical\n1 of 1 cells")


def test_the_column_that_moved_is_named_with_its_plan_and_by_how_much(cell, run, before, capsys):
    rows = run.rows.copy()
    rows[7, 0] += 0.25
    rows[9, 0] -= 0.5
    assert gate.compare({str(cell): replace(run, rows=rows)}, before, whole=True) == 1
    out = capsys.readouterr().out
    assert f"MOVED    {cell} (of the same source): command from plan 7 by 0.25, at most by 0.5\n" in out
    assert "0 of 1 cells" in out


def test_a_number_that_becomes_nan_has_moved_and_one_that_was_has_not(run):
    rows = run.rows.copy()
    rows[3, 1] = np.nan
    spoilt = replace(run, rows=rows)
    assert "joint_q from plan 3 by nan" in gate.difference(spoilt, run)
    assert gate.difference(spoilt, spoilt) is None


def test_other_source_is_told_and_is_no_failure(cell, run, before, capsys):
    assert run.source
    assert gate.compare({str(cell): replace(run, source="other")}, before, whole=True) == 0
    assert "0 of 1 cells with source of their own have the same source" in capsys.readouterr().out


def test_the_digest_is_of_source_that_warpmpc_makes_while_it_is_watched():
    def digest(*sources, module="warpmpc.engine"):
        with gate.sources() as digest:
            for source in sources:

                def made(x: float): ...

                made.__module__ = module
                wp.func_native(snippet=source)(made)
        return digest()

    assert digest() == ""
    assert digest("return;", module="mujoco_warp.solver") == ""
    assert digest("return;") == digest("return;") != digest("return ;")


def test_a_cell_that_is_gone_counts_where_all_were_run(before, capsys):
    assert gate.compare({}, before, whole=False) == 0
    assert gate.compare({}, before, whole=True) == 1
    assert "GONE" in capsys.readouterr().out
