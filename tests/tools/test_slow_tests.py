# SPDX-License-Identifier: Apache-2.0
"""Tests that the suite leaves out are run by CI, or their file says how they are run."""

import ast
import re

import pytest
from pages import ROOT

FILES = sorted(ROOT.joinpath("tests").rglob("test_*.py"))
SLOW = [str(file.relative_to(ROOT)) for file in FILES if re.search(r"\bmark\.slow\b", file.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("name", SLOW)
def test_a_file_with_slow_tests_is_run_or_says_how(name):
    chosen = re.search(r'^slow="(.*?)"$', (ROOT / ".ci" / "run").read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)[
        1
    ]
    by_ci = any(name == path or name.startswith(f"{path}/") for path in chosen.split())
    text = (ROOT / name).read_text(encoding="utf-8")
    assert by_ci or f"pytest -m slow {name}" in ast.get_docstring(ast.parse(text))
