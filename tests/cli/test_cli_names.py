# SPDX-License-Identifier: Apache-2.0
"""Names in files and of files send no control sequences to the terminal, in any command."""

import ast
import json
import logging
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from needs import need

import warpmpc.cli
from warpmpc.cli.terminal import Plain
from warpmpc.scene.registry import ROBOTS

CLEAR, SHORT = "\x1b[2J", "\x9b2J"
"""What clears a terminal, in seven bits and in eight."""
ROBOT = """<mujoco><worldbody><body name="cart{0}"><joint name="slide{0}" type="slide" axis="1 0 0" range="-2 2"/>
<geom name="g{0}" size=".1"/><body name="arm{0}" pos="0 0 .2"><joint name="turn{0}" axis="0 1 0"/>
<geom size=".05" mass=".1"/></body></body></worldbody><actuator><motor name="push{0}" joint="slide{0}"
ctrlrange="-9 9"/></actuator></mujoco>""".format("&#27;[2J&#x9b;2J[b]&#7;")
SCENE = r"""
ground = false
engine.name = "mujoco"
title = "mine\u001b[2J\u009b2J[/b]\u0007"
[timing]
control_dt = 0.04
timeout = 0.4
[[robot]]
name = "cart"
asset = "robot[2J.xml"
[[cost]]
term = "distance"
between = ["cart/arm\u001b[2J\u009b2J[b]\u0007", "goal"]
[goal]
frame = "cart/arm\u001b[2J\u009b2J[b]\u0007"
position = [1.5, 0.0, 0.2]
[planner]
samples = 16
horizon = 4
refine = false
[[success.conditions]]
joint = "cart/slide\u001b[2J\u009b2J[b]\u0007"
above = 1.9
"""


@pytest.fixture
def scene(tmp_path):
    """A scene whose file, robot and title have such names."""
    (tmp_path / f"robot{CLEAR}.xml").write_text(ROBOT)
    text = SCENE.replace("robot[2J", r"robot\u001b[2J")
    (tmp_path / f"mine{CLEAR}.toml").write_text(text)
    return f"mine{CLEAR}.toml"


def check_harmless(done) -> None:
    for text in (done.stdout, done.stderr):
        assert CLEAR not in text
        assert not {"\x1b", "\x9b", "\x07"} & set(text)


def test_what_every_command_prints_of_a_scene(scene, command, tmp_path):
    out = f"run{CLEAR}"
    commands = {
        "check": [],
        "bench": ["--plans", "5"],
        "show": [],
        "tune": [
            "--trials",
            "2",
            "--episodes",
            "1",
            "--jobs",
            "1",
            "--key",
            "cost.distance.weight=1..2",
            "-o",
            f"tuned{CLEAR}.toml",
        ],
        "run": ["--out", out],
    }
    for name, args in commands.items():
        done = command(name, scene, *args)
        assert done.returncode in (0, 1), done.stderr
        check_harmless(done)
        assert r"\x1b[2J" in done.stdout or name not in ("check", "run")
    for args in (["--episodes", "2", "--envs", "2"], ["--json"], ["--real-time", "--set", "planner.samples=8"]):
        done = command("run", scene, *args)
        check_harmless(done)
        assert "--json" not in args or json.loads(done.stdout)["scene"]
    for name in ("replay", "diagnose", "plot"):
        done = command(name, out)
        check_harmless(done)
        assert r"\x1b[2J" in done.stdout
    need("mcap")
    done = command("export", out, "--mcap", f"a{CLEAR}.mcap")
    check_harmless(done)
    assert r"a\x1b[2J.mcap" in done.stdout


def test_colours_of_a_terminal_are_not_those_of_names(scene, command, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    done = command("check", scene)
    assert "\x1b[1m" in done.stdout  # bold, which is ours
    assert not [text for text in (CLEAR, SHORT, "\x07") if text in done.stdout]


def test_names_of_packages(command, monkeypatch):
    monkeypatch.setattr(ROBOTS, "_points", {f"mine{CLEAR}": EntryPoint("a", f"no{SHORT}:make", ROBOTS._group)})
    check_harmless(command("robots"))
    check_harmless(command("robots", f"mine{CLEAR}"))


def test_messages_of_the_log_that_nobody_shows():
    assert Plain().format(logging.makeLogRecord({"msg": "a %s", "args": (CLEAR,)})) == r"a \x1b[2J"


def test_commands_print_by_one_module():
    own = []
    for file in Path(warpmpc.cli.__file__).parent.glob("*.py"):
        calls = [node.func for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call)]
        names = [ast.unparse(call) for call in calls]
        own += [f"{file.name}: {name}" for name in names if name in ("print", "typer.echo", "Console")]
    assert {line.partition(":")[0] for line in own} == {"terminal.py"}, own
