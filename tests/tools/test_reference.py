# SPDX-License-Identifier: Apache-2.0
"""What the documentation's reference is written from: every key has an example, and examples are true."""

import importlib
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel

from warpmpc import Scene, load_scene
from warpmpc.cli.lists import EXAMPLES
from warpmpc.cost.terms import TERMS
from warpmpc.scene.describe import keys, takes

PAGES = Path(__file__).parents[2] / "tools" / "pages"


@pytest.fixture(scope="module")
def examples():
    sys.path.insert(0, str(PAGES))
    yield importlib.import_module("examples").examples()
    sys.path.remove(str(PAGES))


def plain_keys(section: type[BaseModel], visited: set) -> set[tuple[type[BaseModel], str]]:
    """Every key of a section and below that takes values, and no table that has keys."""
    visited.add(section)
    found = set()
    for key, field in keys(section).items():
        inner = [kind for kind in models(field.annotation) if kind not in visited]
        if "table" not in takes(field) or takes(field).startswith("table:"):
            found.add((section, key))
        for kind in inner:
            found |= plain_keys(kind, visited)
    return found


def models(kind: object) -> list[type[BaseModel]]:
    own = [kind] if isinstance(kind, type) and issubclass(kind, BaseModel) else []
    return [*own, *(model for part in getattr(kind, "__args__", ()) for model in models(part))]


def test_every_key_has_an_example(examples):
    wanted = plain_keys(Scene, set())
    for term in TERMS.values():
        wanted |= plain_keys(term.keys, set())
    assert len(wanted) > 250
    missing = {(section.__name__, key) for section, key in wanted - examples.keys()}
    assert not sorted(missing), "show these keys in a scene, on a page, or in warpmpc/cli/examples.toml"


def test_the_examples_kept_for_the_reference_are_a_scene():
    scene = load_scene(EXAMPLES)
    for cost in scene.cost:
        TERMS[cost.term].keys.model_validate(cost.params)
