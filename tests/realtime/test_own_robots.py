# SPDX-License-Identifier: Apache-2.0
"""The program of the page about real time: a MuJoCo loop of one's own."""

import os
import subprocess
import sys

import pytest
from pages import files

PAGE = "docs/tutorial/realtime.md"


@pytest.fixture
def program(tmp_path):
    """Starts a program of the page."""

    def start(name: str, *args: object) -> subprocess.Popen:
        (tmp_path / name).write_text(files(PAGE)[name], encoding="utf-8")
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen([sys.executable, name, *map(str, args)], cwd=tmp_path, env=os.environ, **pipes)

    return start


def test_a_mujoco_loop_of_ones_own_is_a_robot(program):
    out, errors = program("own_mujoco.py", 1.5, 0.15).communicate(timeout=200)
    plans, _, rest = out.splitlines()[-1].partition(" plans")
    assert int(plans) > 10, errors
    assert float(rest.rpartition(" ")[2]) > -0.95, "hanging all the time"
