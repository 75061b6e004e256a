# SPDX-License-Identifier: Apache-2.0
"""What a test needs besides the extra ``dev``, and the command that brings it: a skip names it."""

from __future__ import annotations

import re
import shutil
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import warp as wp

from warpmpc import shipped_scenes
from warpmpc.scene.model.assets import package_dirs

CHROMIUM = Path("/usr/bin/chromium")
CUDA = "a CUDA device"
DEV = 'pip install -e ".[dev]"'
COMMANDS = {
    CUDA: "python -m pytest -m gpu, on a machine that has one",
    "Chromium": "apt-get install chromium",
    "dm_control": 'pip install -e ".[bench]"',
    "g++": "apt-get install g++",
    **dict.fromkeys(("h5py", "mcap", "rosbags"), 'pip install -e ".[export]"'),
    "gymnasium_robotics": "pip install --no-deps gymnasium-robotics",
    "mjlab": 'pip install --no-deps "mjlab==1.6.0"',
    "mkdocs_autorefs": 'pip install -e ".[docs]"',
    "pinocchio": "pip install pin",
    "rclpy": 'pip install -e ".[ros2]"',
    "ray": 'pip install -e ".[cluster]"',
    "ruckig": "pip install ruckig",
    "torch": "pip install torch",
}
"""What brings it; everything else comes with the extra ``dev``."""


def missing(name: str) -> bool:
    """Whether this machine lacks a package, a program or a device."""
    if name == CUDA:
        return not wp.is_cuda_available()
    if name == "Chromium":
        return not CHROMIUM.exists()
    if name == "g++":
        return shutil.which("g++") is None
    if name == "example-robot-data":
        return not any((folder / name).is_dir() for folder in package_dirs())
    return find_spec(name) is None or (name == "rclpy" and not _loads(name))


@cache
def _loads(name: str) -> bool:
    """Whether a package can be imported: ROS 2 may be there without libraries that it loads."""
    try:
        import_module(name)
    except ImportError:
        return False
    return True


def reason(name: str) -> str:
    """Why a test is skipped."""
    return f"needs {name}: {COMMANDS.get(name, DEV)}"


def needs(name: str) -> pytest.MarkDecorator:
    """The mark of a test that is skipped where something is missing."""
    return pytest.mark.skipif(missing(name), reason=reason(name))


def need(name: str) -> None:
    """Skip the test where something is missing."""
    __tracebackhide__ = True  # the skip is the caller's
    if missing(name):
        pytest.skip(reason(name))


def need_scene(name: str) -> None:
    """Skip the test where the package of a robot of a shipped scene is missing."""
    __tracebackhide__ = True
    for package in re.findall(r"package://([\w-]+)/", shipped_scenes()[name].read_text(encoding="utf-8")):
        need(package)


class Lacking:
    """Notes which tests and files are skipped for want of what a command installs.

    Args:
        file: Where their ids go, one a line.
    """

    def __init__(self, file: Path):
        self._file, self._ids = file, dict[str, None]()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A part of a test is over."""
        self._take(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """A file has been collected."""
        self._take(report)

    def pytest_sessionfinish(self) -> None:
        """Write the file."""
        self._file.write_text("".join(f"{name}\n" for name in self._ids))

    def _take(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if report.skipped and isinstance(report.longrepr, tuple) and " install " in report.longrepr[2]:
            self._ids[report.nodeid] = None
