# SPDX-License-Identifier: Apache-2.0
"""The program of the page about real time: your own driver."""

import os
import subprocess
import sys

from pages import files

PAGE = "docs/tutorial/realtime.md"


def test_a_mujoco_loop_of_ones_own_is_a_robot(tmp_path):
    (tmp_path / "own_mujoco.py").write_text(files(PAGE)["own_mujoco.py"], encoding="utf-8")
    command = [sys.executable, "own_mujoco.py", "engine.threads=1", "timing.timeout=1.0"]
    done = subprocess.run(command, cwd=tmp_path, env=os.environ, capture_output=True, text=True, timeout=250)
    plans, _, _, time, _ = done.stdout.splitlines()[-1].split(" ")
    assert int(plans) > 10, done.stderr
    assert float(time) == 1.0
