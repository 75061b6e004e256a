# SPDX-License-Identifier: Apache-2.0
"""Every tool can be loaded: what it imports from the package and from other tools is there."""

import importlib
import sys
from pathlib import Path

import pytest
from needs import reason
from shared import commands

TOOLS = Path(__file__).parents[2] / "tools"
MODULES = sorted(
    ".".join(file.relative_to(TOOLS).with_suffix("").parts)
    for folder in ("", "benches", "studies", "shared", "learned")
    for file in (TOOLS / folder).glob("*.py")
    if file.stem != "__init__"
)
OPTIONAL = {"dm_control", "matplotlib", "torch", "ray"}
"""Packages of extras; without them a tool says so."""


@pytest.mark.parametrize("name", MODULES)
def test_a_tool_loads(name):
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name.partition(".")[0] not in OPTIONAL:
            raise
        pytest.skip(reason(error.name.partition(".")[0]))
    assert module.__doc__
    if name.partition(".")[0] in ("benches", "studies"):
        assert callable(module.main)


def test_the_help_lists_every_subcommand_in_a_line(capsys, monkeypatch):
    for package, program in (("benches", "bench.py"), ("studies", "study.py")):
        monkeypatch.setattr(sys, "argv", [program])
        assert commands.run(package, "Some.", ["--help"]) == 0
        lines = capsys.readouterr().out.splitlines()[3:]
        assert [line.split()[0] for line in lines] == sorted(commands.subcommands(package))
        assert all(len(line.split()) > 5 for line in lines)


def test_a_subcommand_gets_the_arguments_behind_it(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["bench.py", "plans", "--help"])
    with pytest.raises(SystemExit) as end:
        commands.run("benches", "Some.", ["plans", "--help"])
    assert end.value.code == 0
    assert capsys.readouterr().out.startswith("usage: bench.py plans ")
    assert commands.run("benches", "Some.", ["plan"]) == 2
    assert "no subcommand 'plan'; there is: agreement, " in capsys.readouterr().err
