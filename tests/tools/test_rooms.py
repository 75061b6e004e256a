# SPDX-License-Identifier: Apache-2.0
"""Rooms import downwards only and keep their budgets of lines, and the picture in the docs is theirs."""

from pathlib import Path

from rooms import FLOOR, circles, imports, mermaid, over_budget

ARCHITECTURE = Path(__file__).parents[2] / "docs" / "architecture.md"


def test_rooms_import_downwards_only():
    found = imports()
    assert len([i for i in found if not i.typing]) > 50
    assert [f"{i.file}:{i.line}" for i in found if FLOOR[i.target] >= FLOOR[i.room]] == []


def test_no_modules_of_a_room_import_each_other_in_a_circle():
    assert circles() == []


def test_rooms_keep_their_budgets_of_lines():
    assert over_budget() == []


def test_physics_knows_numbers_alone():
    """MuJoCo's models and source: no scene, no cost, no layout."""
    assert {i.target for i in imports() if i.room == "physics"} == {"kernels"}


def test_the_picture_in_the_docs_is_that_of_the_source():
    below = [i for i in imports() if FLOOR[i.target] < FLOOR[i.room]]
    assert f"```mermaid\n{mermaid(below)}\n```" in ARCHITECTURE.read_text(encoding="utf-8")
