# SPDX-License-Identifier: Apache-2.0
"""The README's example of a user's own robot and cost, and its Python snippet, run as they stand there.

Slow ones by hand: pytest -m slow tests/test_readme.py
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from pages import blocks, files, write_files

README = "README.md"


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    folder = tmp_path_factory.mktemp("example")
    assert set(files(README)) == {"cart.urdf", "upright.py", "swing_up.toml"}
    write_files(README, folder)
    return folder


def run(folder: Path, *args: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "warpmpc.cli.main", *args], cwd=folder, capture_output=True, text=True, timeout=280
    )


@pytest.mark.parametrize("episodes", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_users_own_robot_and_cost_swing_the_pole_up(example, episodes):
    done = run(example, "run", "swing_up.toml", "--terms", "upright.py", "--episodes", str(episodes), "--json")
    results = [json.loads(line) for line in done.stdout.splitlines()]
    assert [r["success"] for r in results] == [True] * episodes, done.stderr
    assert all(r["diverged_worlds"] == 0 for r in results)


def test_without_the_users_terms_the_scene_says_what_is_missing(example):
    done = run(example, "run", "swing_up.toml")
    assert done.returncode == 2
    assert "upright" in done.stderr
    assert "swing_up.toml" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_python_snippet_runs_as_written(tmp_path):
    snippet = next(text for kind, text in blocks(README) if kind == "python" and "Controller(scene" in text)
    # the same code on a shorter run
    snippet = snippet.replace(
        'load_scene("omni_push_box")', 'load_scene("omni_push_box", overrides=["timing.timeout=0.4"])'
    )
    assert "overrides" in snippet
    done = subprocess.run([sys.executable, "-c", snippet], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "timeout 0.4 s" in done.stdout
