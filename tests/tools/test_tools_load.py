# SPDX-License-Identifier: Apache-2.0
"""Every tool can be loaded: what it imports from the package and from other tools is there."""

import importlib
from pathlib import Path

import pytest
from needs import reason

TOOLS = sorted(path.stem for path in (Path(__file__).parents[2] / "tools").glob("*.py"))
OPTIONAL = {"dm_control", "ompl", "optuna", "matplotlib", "torch", "mink", "ray"}
"""Packages of extras; without them a tool says so."""


@pytest.mark.parametrize("name", TOOLS)
def test_a_tool_loads(name):
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name.partition(".")[0] not in OPTIONAL:
            raise
        pytest.skip(reason(error.name.partition(".")[0]))
    assert module.__doc__
