# SPDX-License-Identifier: Apache-2.0
"""A term, a strategy, a robot and a command are a file each, used through the program; the core needs no extras."""

import json
import os
import subprocess
import sys
import tomllib

import pytest
from pages import ROOT, files

import warpmpc
from warpmpc.engine.registry import ENGINES
from warpmpc.planner.step import STRATEGIES

SCENE = """
engine.name = "mujoco"
[timing]
control_dt = 0.04
timeout = 4.0
[[robot]]
name = "base"
asset = "assets/point_robot.urdf"
drive = [{ mode = "velocity", joints = ["x", "y", "yaw"], damping = 300.0, effort_limit = 200.0, limit = 2.5 }]
[goal]
frame = "base/base_link"
position = [0.4, 0.2]
[[cost]]
term = "TERM"
between = ["base/base_link", "goal"]
[planner]
method = "METHOD"
samples = 16
horizon = 6
refine = false
noise = { sigma = [0.5, 0.5, 0.5] }
[success]
distance = 0.15
"""
TERM = """
import warpmpc
from warpmpc.cost.terms import TERMS as SHIPPED
from warpmpc.scene.registry import TERMS
TERMS.register("mine", SHIPPED["distance"])
"""
PAGE = "docs/architecture.md"
GREEDY = files(PAGE)["greedy.py"].replace('"greedy"', '"mine"')
STRATEGY = """
from warpmpc.planner.strategy import SamplingStrategy
from warpmpc.scene.registry import STRATEGIES
class Mine(SamplingStrategy):
    def __init__(self, *args, **keys):
        super().__init__(*args, **keys)
        print("planned by mine", flush=True)
STRATEGIES.register("mine", Mine)
"""
ROBOT = """
from warpmpc import simulated_robot
from warpmpc.scene.registry import ROBOTS
def make(scene, **keys):
    print("driven by mine", flush=True)
    return simulated_robot(scene, **keys)
ROBOTS.register("mine", make)
"""
ENGINE = """
from dataclasses import replace
from warpmpc.engine.registry import ENGINES, register
register(replace(ENGINES["mujoco"], name="mine"))
"""
OVERRIDE = """
from functools import partial
from warpmpc.scene.registry import STRATEGIES
import warpmpc.planner.step
STRATEGIES["mppi"] = partial(STRATEGIES["mppi"])
"""
COMMAND = """
import typer, warpmpc
NUMBER = 3
def greet(name: str) -> None:
    \"\"\"Say hello.\"\"\"
    typer.echo(f"hello {name}")
def fail() -> None:
    warpmpc.load_scene("omni_push_bax")
"""
POINTS = """
[warpmpc.commands]
greet = greeting:greet
fail = greeting:fail
broken = greeting:nothing
number = greeting:NUMBER
check = greeting:greet
run = greeting:greet
"""
WITHOUT_EXTRAS = """
import importlib.abc, importlib.metadata, sys
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.startswith(("warpmpc.extras", "warpmpc.cli.extra_commands")):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
found = importlib.metadata.entry_points
importlib.metadata.entry_points = lambda **keys: [p for p in found(**keys) if "extra" not in p.value]
from warpmpc.cli.main import main
main()
"""


def call(*arguments, folder, program=("-m", "warpmpc"), path=None):
    """The program's end, in a folder."""
    environment = os.environ | ({"PYTHONPATH": str(path)} if path else {})
    return subprocess.run(
        [sys.executable, *program, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=200
    )


def scene(folder, *, term="distance", method="mppi"):
    """A scene file in a folder."""
    (folder / "mine.toml").write_text(SCENE.replace("TERM", term).replace("METHOD", method))


@pytest.mark.parametrize(
    ("text", "options", "says"),
    [
        (TERM + GREEDY, ["--episodes", "2", "--jobs", "2"], ""),
        (TERM + STRATEGY + ROBOT, ["--real-time", "--robot", "mine"], "driven by mine"),
    ],
    ids=["term-strategy-of-the-page-jobs", "term-strategy-robot-real-time"],
)
def test_a_part_of_ones_own_is_one_file(tmp_path, text, options, says):
    scene(tmp_path, term="mine", method="mine")
    (tmp_path / "mine.py").write_text(text)
    done = call("run", "mine.toml", "--terms", "mine.py", "--json", *options, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert says in done.stdout + done.stderr
    results = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert results
    assert all(result.get("steps", result.get("ticks", 0)) > 2 for result in results)


@pytest.mark.parametrize("text", [TERM, STRATEGY, ENGINE, OVERRIDE], ids=["term", "strategy", "engine", "override"])
def test_a_file_that_is_executed_again_brings_the_same(tmp_path, text):
    file = tmp_path / "mine.py"
    file.write_text(text)
    before = [dict(registry) for registry in (ENGINES, STRATEGIES)]
    for _ in range(2):
        terms = warpmpc.load_terms(file)
        assert len(terms) == (text == TERM)
        assert {"fused", "mujoco"} <= set(ENGINES)
        assert {"mppi", "cem"} <= set(STRATEGIES)
    found = {"term": None, "strategy": STRATEGIES.get("mine"), "engine": ENGINES.get("mine")}
    assert [name for name, made in found.items() if made is not None] == {
        TERM: [],
        STRATEGY: ["strategy"],
        ENGINE: ["engine"],
        OVERRIDE: [],
    }[text]
    file.write_text(text + "raise RuntimeError('no')\n")
    with pytest.raises(ValueError, match="RuntimeError: no"):
        warpmpc.load_terms(file)
    assert [dict(registry) for registry in (ENGINES, STRATEGIES)] == before


def test_a_name_that_is_taken_is_told_with_the_files_line(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("from warpmpc.scene.registry import STRATEGIES\nSTRATEGIES.register('mppi', print)\n")
    with pytest.raises(ValueError, match=r"mine\.py:2: ValueError: there is a strategy 'mppi' already"):
        warpmpc.load_terms(file)


def test_a_run_with_a_strategy_of_a_file_is_replayed_with_the_file(tmp_path):
    scene(tmp_path, method="mine")
    (tmp_path / "mine.py").write_text(STRATEGY)
    done = call("run", "mine.toml", "--terms", "mine.py", "--out", "out", "--advise", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "planned by mine" in done.stdout + done.stderr
    done = call("replay", "out", "--terms", "mine.py", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "agree bit for bit" in done.stdout


def test_a_strategy_of_a_file_that_is_not_given_is_no_choice(tmp_path, command):
    scene(tmp_path, method="mine")
    done = command("run", "mine.toml")
    assert done.returncode == 2
    assert "planner.method" in done.stderr


def test_a_command_is_a_function_and_an_entry_point(tmp_path):
    (tmp_path / "greeting.py").write_text(COMMAND)
    folder = tmp_path / "greeting-1.0.dist-info"
    folder.mkdir()
    (folder / "entry_points.txt").write_text(POINTS)
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: greeting\nVersion: 1.0\n")
    done = call("greet", "you", folder=tmp_path, path=tmp_path)
    assert done.stdout == "hello you\n"
    assert "'run' of greeting 1.0 is left out" in done.stderr
    failed = call("fail", folder=tmp_path, path=tmp_path)
    assert (failed.returncode, failed.stderr.splitlines()[-1][:32]) == (2, "error: omni_push_bax: no such sc")
    broken = call("broken", folder=tmp_path, path=tmp_path)
    assert broken.returncode == 2
    assert "greeting:nothing" in broken.stderr
    number = call("number", folder=tmp_path, path=tmp_path)
    assert number.returncode == 2
    assert "the command 'number' of greeting 1.0" in number.stderr
    assert "'check' of greeting 1.0 is left out: warpmpc has it" in number.stderr


def test_the_entry_points_on_the_page_of_own_parts_are_found(tmp_path):
    block = (ROOT / PAGE).read_text().partition("```ini\n")[2].partition("```")[0]
    points = tomllib.loads(block)["project"]["entry-points"]
    assert list(points) == ["warpmpc.robots", "warpmpc.commands"]
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "robot.py").write_text(
        'def make(scene, *, compiled, config=None, **_):\n    """Mine."""\n'
    )
    (tmp_path / "my_package" / "commands.py").write_text(COMMAND + "draw = greet\n")
    folder = tmp_path / "my_package-1.0.dist-info"
    folder.mkdir()
    lines = [f"[{group}]\n" + "".join(f"{n} = {v}\n" for n, v in entries.items()) for group, entries in points.items()]
    (folder / "entry_points.txt").write_text("".join(lines))
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n")
    assert call("draw", "you", folder=tmp_path, path=tmp_path).stdout == "hello you\n"
    assert "own (from my_package 1.0)\n  Mine." in call("robots", "own", folder=tmp_path, path=tmp_path).stdout


def test_an_observer_that_cannot_be_loaded_is_left_out_with_a_warning(tmp_path):
    scene(tmp_path)
    folder = tmp_path / "watching-1.0.dist-info"
    folder.mkdir()
    (folder / "entry_points.txt").write_text("[warpmpc.observers]\nbroken = nowhere:Nothing\n")
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: watching\nVersion: 1.0\n")
    done = call("run", "mine.toml", "--json", folder=tmp_path, path=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("the observer 'broken' (nowhere:Nothing) cannot be loaded") == 1


def test_the_core_runs_without_the_extras(tmp_path):
    scene(tmp_path)
    program = ("-c", WITHOUT_EXTRAS)
    done = call("run", "mine.toml", "--json", "--npz", "run.npz", folder=tmp_path, program=program)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run.npz").exists()
    assert "No such command 'live'" in call("live", "mine.toml", folder=tmp_path, program=program).stderr
