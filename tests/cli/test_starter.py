# SPDX-License-Identifier: Apache-2.0
"""``warpmpc new``: what it writes runs as it is, and it writes over nothing."""

import json
import runpy
import tomllib

import pytest
from jsonschema import Draft7Validator
from program import results, warpmpc

from warpmpc import load_scene
from warpmpc.cli.lists import make_starter


@pytest.fixture(scope="module")
def starter(tmp_path_factory):
    folder = tmp_path_factory.mktemp("somewhere") / "mine"
    done = warpmpc("new", folder)
    assert (done.returncode, done.stderr) == (0, "")
    listed = {line.rpartition("/")[2] for line in done.stdout.splitlines()[:-1]}
    assert listed == {file.name for file in folder.iterdir()}
    assert listed == {"README.md", "arm.urdf", "cost.py", "loop.py", "scene.schema.json", "scene.toml"}
    return folder


def test_its_scene_reaches_its_goal(starter, command, monkeypatch):
    monkeypatch.chdir(starter)
    done = command("run", "scene.toml", "--terms", "cost.py", "--json")
    assert done.stderr == ""
    assert [result["success"] for result in results(done)] == [True]
    assert results(done)[0]["collisions"]["max_force_N"] == 0.0
    low = load_scene(starter / "scene.toml:low")
    assert low.goal.position[2] < load_scene(starter / "scene.toml").goal.position[2]


def test_its_loop_does_so_too(starter, monkeypatch, capsys):
    monkeypatch.chdir(starter)
    runpy.run_path("loop.py")
    assert capsys.readouterr().out.splitlines()[-1].startswith("goal reached")


def test_its_schema_is_that_of_its_scene(starter):
    text = (starter / "scene.toml").read_text(encoding="utf-8")
    assert text.startswith("#:schema scene.schema.json\n")
    schema = json.loads((starter / "scene.schema.json").read_text(encoding="utf-8"))
    assert Draft7Validator(schema).is_valid(tomllib.loads(text))


def test_it_writes_over_nothing(starter, command, tmp_path):
    before = (starter / "scene.toml").read_bytes()
    file = tmp_path / "file"
    file.write_text("mine")
    done = command("new", str(starter))
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {starter}: is not empty")
    assert len(done.stderr.splitlines()) == 1
    with pytest.raises(ValueError, match="is a file"):
        make_starter(file)
    assert (starter / "scene.toml").read_bytes() == before
    assert file.read_text() == "mine"
