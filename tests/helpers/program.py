# SPDX-License-Identifier: Apache-2.0
"""Runs the command line as a user does: as a separate program."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

PROGRAM = [sys.executable, "-m", "warpmpc.cli.main"]

TINY = ["--set", "planner.samples=16", "--set", "planner.horizon=4", "--set", "planner.refine=false"]
TINY += ["--set", "timing.timeout=0.4"]
"""Ten controls from few samples alone: nothing is reached."""

SCENE = """
engine.name = "mujoco"

[[robot]]
name = "base"
asset = "omni_base.urdf"
drive = { damping = 600.0, effort_limit = 100.0, limit = [0.8, 0.8, 1.0] }
frames.tip = { link = "base_link" }

[[object]]
name = "box"
shape = "box"
size = [0.3, 0.5, 0.3]
mass = 1.0
position = [1.0, 0.0, 0.15]

[goal]
object = "box"
position = [2.0, 0.0]

[[cost]]
term = "distance"
between = ["base/tip", "box"]

[planner]
samples = 16
horizon = 4
dt = 0.04
iterations = 1
refine = false

[success]
position = 0.05

[variants.near]
goal.position = [1.2, 0.0]
"""


def warpmpc(*args: str | Path, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run ``warpmpc ARGS`` in a folder."""
    command = [*PROGRAM, *map(str, args)]
    env = {**os.environ}  # without the COLUMNS that readline sets behind Python's back
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, encoding="utf-8", timeout=280)


def results(done: subprocess.CompletedProcess[str]) -> list[dict]:
    """What ``--json`` printed, every line of it."""

    def reject(constant: str) -> None:
        raise ValueError(f"{constant} is not JSON")

    return [json.loads(line, parse_constant=reject) for line in done.stdout.splitlines()]


def untimed(result: dict) -> dict:
    """A result without its wall times."""
    return {key: value for key, value in result.items() if key not in ("plan_ms", "stages_ms")}


@contextmanager
def small_disk(size: int):
    """Files hold no more than some bytes, as on a disk that is full."""
    import resource  # not on Windows

    limits, writes_none = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # Python takes no notice where it cannot write all of it
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        sys.dont_write_bytecode = writes_none
