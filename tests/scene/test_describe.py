# SPDX-License-Identifier: Apache-2.0
"""Every key of a scene file says what it means, and in words what it takes."""

from typing import get_args

import pytest
from pydantic import BaseModel

from warpmpc import Scene
from warpmpc.cost.terms import TERMS
from warpmpc.cost.terms.collision import SelfCollision, WorldCollision
from warpmpc.scene.describe import default, keys, takes, unit
from warpmpc.scene.schema import Cloud, Drive, Noise, Obstacle, Planner, Robot


def sections() -> list[type[BaseModel]]:
    """All sections of a scene file, and the keys of built-in terms."""
    found: dict[type[BaseModel], None] = {}

    def visit(kind: object) -> None:
        for part in get_args(kind):
            visit(part)
        if isinstance(kind, type) and issubclass(kind, BaseModel) and kind not in found:
            found[kind] = None
            for field in kind.model_fields.values():
                visit(field.annotation)

    for root in (Scene, *(term.keys for term in TERMS.values())):
        visit(root)
    return list(found)


@pytest.mark.parametrize("section", sections(), ids=lambda section: section.__name__)
def test_every_key_says_what_it_means(section):
    assert [name for name, field in keys(section).items() if not field.description] == []


@pytest.mark.parametrize(
    ("section", "key", "words", "units", "left_out"),
    [
        (SelfCollision, "ignore", "[[text, text], ...]", "", "-"),
        (WorldCollision, "against", "text or [text, ...]", "", '["obstacles"]'),
        (WorldCollision, "form", "distance | binary", "", '"distance"'),
        (Planner, "domains", "whole number ≥ 1", "", "1"),
        (Planner, "dt", "number > 0 or [number > 0, ...] or table", "s", "-"),
        (Noise, "sigma", "number > 0 or [number > 0, ...] or table", "", "{ range = [0.25] }"),
        (Drive, "effort_limit", "number > 0 or [number > 0, ...]", "N or N·m", "-"),
        (Robot, "asset", "text", "", "required"),
        (Robot, "position", "[number, number, number]", "m", "-"),  # the asset's own
        (Obstacle, "position", "[number, number, number]", "m", "[0.0, 0.0, 0.0]"),
        (Robot, "drive", "table or array of tables", "", "-"),
        (Robot, "frames", "tables by name", "", "-"),
        (Robot, "armature", "number ≥ 0 or [number ≥ 0, ...]", "kg or kg·m²", "-"),
        (Obstacle, "color", "[number ≥ 0 and ≤ 1, number ≥ 0 and ≤ 1, number ≥ 0 and ≤ 1]", "", "-"),
        (Obstacle, "movable", "true | false", "", "false"),
        (Scene, "scalar", "table: name = number", "", "-"),
        (Cloud, "voxel", "number > 0", "m", "0.025"),
    ],
)
def test_types_units_and_defaults_are_said_as_a_file_would_write_them(section, key, words, units, left_out):
    field = keys(section)[key]
    assert (takes(field), unit(field), default(field)) == (words, units, left_out)


def test_what_a_file_cannot_say_is_no_key():
    assert {"path", "variant"} & keys(Scene).keys() == set()
