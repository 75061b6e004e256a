# SPDX-License-Identifier: Apache-2.0
"""The program of the page about real time: your own driver."""

import json
import os
import subprocess
import sys

from pages import ROOT, files

PAGE = "docs/tutorial/realtime.md"


def test_a_mujoco_loop_of_ones_own_is_a_robot(tmp_path):
    (tmp_path / "own_mujoco.py").write_text(files(PAGE)["own_mujoco.py"], encoding="utf-8")
    command = [sys.executable, "own_mujoco.py", "engine.threads=1", "timing.timeout=1.0"]
    done = subprocess.run(command, cwd=tmp_path, env=os.environ, capture_output=True, text=True, timeout=250)
    plans, _, _, time, _ = done.stdout.splitlines()[-1].split(" ")
    assert int(plans) > 10, done.stderr
    assert float(time) == 1.0


RUN = "run cartpole_swingup --real-time --speed 0.3 --robot own --terms own_mujoco.py"


def test_the_program_drives_it_from_its_file(tmp_path):
    assert f"`warpmpc {RUN}`" in (ROOT / PAGE).read_text(encoding="utf-8")
    (tmp_path / "own_mujoco.py").write_text(files(PAGE)["own_mujoco.py"], encoding="utf-8")
    short = ["--set", "engine.threads=1", "--set", "timing.timeout=0.5", "--json"]
    command = [sys.executable, "-m", "warpmpc", *RUN.split(), *short]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=250)
    assert json.loads(done.stdout)["reason"] == "timeout", done.stderr
