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
    for pattern in ("*.py", "benches/*.py", "studies/*/*.py", "studies/*/*/*.py", "shared/*.py")
    for file in TOOLS.glob(pattern)
    if file.stem != "__init__"
)
OPTIONAL = {"dm_control", "matplotlib", "torch", "ray", "casadi"}
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
    if name.startswith("benches."):
        assert callable(module.main)


def test_the_help_lists_every_subcommand_in_a_line(capsys, monkeypatch):
    for package, program in (("benches", "bench.py"), ("studies", "study.py")):
        monkeypatch.setattr(sys, "argv", [program])
        assert commands.run(package, "Some.", ["--help"]) == 0
        lines = capsys.readouterr().out.splitlines()[3:]
        assert [line.split()[0] for line in lines] == sorted(commands.subcommands(package))
        assert all(len(line.split()) > 5 for line in lines)


def test_every_study_is_a_subcommand_and_says_how_it_is_used(monkeypatch, capsys):
    studies = commands.modules("studies")
    assert {module.split(".")[1] for module in studies.values()} == {
        folder.name for folder in (TOOLS / "studies").iterdir() if (folder / "__init__.py").exists()
    }
    for name in studies:
        monkeypatch.setattr(sys, "argv", ["study.py"])
        with pytest.raises(SystemExit) as end:
            commands.run("studies", "Some.", [name, "--help"])
        assert end.value.code == 0
        assert capsys.readouterr().out.startswith(f"usage: study.py {name} ")


def test_a_subcommand_gets_the_arguments_behind_it(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["bench.py", "plans", "--help"])
    with pytest.raises(SystemExit) as end:
        commands.run("benches", "Some.", ["plans", "--help"])
    assert end.value.code == 0
    assert capsys.readouterr().out.startswith("usage: bench.py plans ")
    assert commands.run("benches", "Some.", ["plan"]) == 2
    assert "no subcommand 'plan'; there is: agreement, " in capsys.readouterr().err
