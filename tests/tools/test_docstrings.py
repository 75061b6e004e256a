# SPDX-License-Identifier: Apache-2.0
"""Docstrings begin with a noun or a verb."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
QUESTION = re.compile(r"(What|Whatever|Whether|Who|Whom|Whoever|How|Why|When|Where|Which)\b", re.IGNORECASE)


def docstrings(file: Path) -> list[tuple[int, str]]:
    """Line and text of every docstring of a module, its classes and its functions."""
    kinds = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    nodes = [node for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, kinds)]
    return [(node.body[0].lineno, ast.get_docstring(node)) for node in nodes if ast.get_docstring(node)]


@pytest.mark.parametrize("folder", ["warpmpc", "kernels"])
def test_no_docstring_begins_with_a_question_word(folder):
    found = [(file, line, text) for file in (ROOT / folder).rglob("*.py") for line, text in docstrings(file)]
    assert len(found) > 100
    assert [f"{f.relative_to(ROOT)}:{line}: {text}" for f, line, text in found if QUESTION.match(text)] == []
