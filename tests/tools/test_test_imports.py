# SPDX-License-Identifier: Apache-2.0
"""Tests import nothing from other tests: what several need stands in tests/helpers."""

import ast
from pathlib import Path

TESTS = Path(__file__).parents[1]


def imported(file: Path) -> set[str]:
    """First parts of the names of all modules that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{file}:{node.lineno}: a relative import"
            names.add(node.module.partition(".")[0])
    return names


def test_no_test_imports_another():
    tests = {file.stem for file in TESTS.rglob("test_*.py")}
    files = list(TESTS.rglob("*.py"))
    assert len(files) > 100
    assert {str(file.relative_to(TESTS)): found for file in files if (found := imported(file) & tests)} == {}


def test_helpers_have_names_of_their_own():
    """They are imported by their bare names, as are tools and whatever is installed."""
    helpers = {file.stem for file in (TESTS / "helpers").glob("*.py")}
    folder = TESTS.parent / "tools"
    tools = {file.stem for file in folder.glob("*.py")} | {file.parent.name for file in folder.glob("*/__init__.py")}
    assert not helpers & tools


def test_no_two_files_of_tests_have_the_same_name():
    """They are modules without packages: pytest would collect one of them alone."""
    names = [file.stem for file in TESTS.rglob("test_*.py")]
    assert {name for name in names if names.count(name) > 1} == set()
