# SPDX-License-Identifier: Apache-2.0
"""The JSON Schema of scene files: it takes what the loader takes, and refuses what editors can know to be wrong."""

import json
import re
import tomllib
from pathlib import Path

import pytest
from jsonschema import Draft7Validator
from program import warpmpc

from warpmpc import shipped_scenes
from warpmpc.cost.terms import TERMS

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]

SCENE = """
[[robot]]
name = "base"
asset = "omni_base.urdf"
drive = { damping = 600.0, limit = 0.8 }

[[cost]]
term = "distance"
between = ["base/tip", "goal"]

[success]
conditions = { joint = "x", above = 1 }
"""


@pytest.fixture(scope="module")
def validator():
    done = warpmpc("schema")
    assert (done.returncode, done.stderr) == (0, "")
    schema = json.loads(done.stdout)
    Draft7Validator.check_schema(schema)
    return Draft7Validator(schema)


def whole_scenes() -> dict[str, str]:
    """Every scene that is shipped or shown whole on a page, by where it stands."""
    scenes = {name: path.read_text(encoding="utf-8") for name, path in shipped_scenes().items()}
    for page in PAGES:
        for i, text in enumerate(re.findall(r"^```toml[^\n]*\n(.*?)^```$", page.read_text(), re.M | re.S)):
            if "[[robot]]" in text and "[success]" in text:
                scenes[f"{page.name}-{i}"] = text
    return scenes


@pytest.mark.parametrize("name", whole_scenes())
def test_every_scene_that_is_shown_fits(name, validator):
    assert [error.message for error in validator.iter_errors(tomllib.loads(whole_scenes()[name]))] == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('name = "base"', 'nmae = "base"'),
        ("damping = 600.0", 'damping = "600"'),
        ("limit = 0.8", "limit = -0.8"),
        ("limit = 0.8", 'mode = "velocty", limit = 0.8'),
        ('term = "distance"', 'term = "distance"\nbetwen = 1'),
        ('between = ["base/tip", "goal"]', ""),
        ('between = ["base/tip", "goal"]', 'between = ["base/tip"]'),
        ('asset = "omni_base.urdf"', ""),
        ("[success]", "[sucess]"),
        ("[success]", "[planner]\nsamples = 1\n[success]"),
        ("[success]", '[planner]\nnoise.shape = "white"\n[success]'),
    ],
)
def test_mistakes_that_an_editor_can_know_do_not(old, new, validator):
    assert validator.is_valid(tomllib.loads(SCENE))
    assert old in SCENE
    assert not validator.is_valid(tomllib.loads(SCENE.replace(old, new)))


@pytest.mark.parametrize(
    "extra",
    [
        "ground = false",
        "planner.temperature.eta = false",
        "planner.dt = { first = 0.04, last = 0.16 }",
        "planner.noise.sigma = [0.1, 0.2]",
        "planner.noise.sigma = 1",
        "robot_is = 1",
    ],
)
def test_what_the_loader_takes_in_several_ways_may_be_written_so(extra, validator):
    assert validator.is_valid(tomllib.loads(f"{extra}\n{SCENE}")) == (extra != "robot_is = 1")


def test_terms_of_the_user_may_have_any_keys_and_each_built_in_one_its_own(validator):
    mine = SCENE.replace('term = "distance"\nbetween', 'term = "upright"\nframe')
    assert validator.is_valid(tomllib.loads(mine))
    choices = validator.schema["$defs"]["Cost"]["oneOf"]
    assert [choice["title"] for choice in choices] == [*TERMS, "your own term"]
    for choice, term in zip(choices, TERMS.values(), strict=False):
        own = {"term", "name", "weight", "terminal", "when"} | term.keys.model_fields.keys()
        assert choice["properties"].keys() == own
        assert choice["description"] == term.summary.replace("``", "`")
