# SPDX-License-Identifier: Apache-2.0
"""The page of kernels names those that plans launch."""

import importlib.util

import pytest
from pages import ROOT

PAGE = (ROOT / "docs" / "reference" / "kernels.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("engine", "column"), [("fused", 3), ("mujoco", 4)])
def test_the_page_has_the_kernels_of_a_plan(engine, column):
    spec = importlib.util.spec_from_file_location("kernels_page", ROOT / "tools" / "pages" / "kernels.py")
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    rows = [line.split("|") for line in PAGE.splitlines() if line.startswith("|`")]
    assert {row[1].strip("`") for row in rows if row[column] == "yes"} == set(tool.launched(engine))
