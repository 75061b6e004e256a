# SPDX-License-Identifier: Apache-2.0
"""Whatever is imported is also installed, or a line says how to get it: rooms, their files, dependencies, extras."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import warpmpc

ROOT = Path(__file__).parents[1]


def test_every_package_and_every_file_that_is_read_is_installed():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    listed = set(settings["packages"])
    rooms = {"warpmpc": ROOT / "warpmpc", "warpmpc.kernels": ROOT / "kernels"}
    found = {
        ".".join((name, *path.parent.relative_to(room).parts))
        for name, room in rooms.items()
        for path in room.rglob("__init__.py")
    }
    assert found <= listed
    headers = {path.parent for path in (ROOT / "warpmpc").rglob("*.h")}
    assert headers == {ROOT / "warpmpc/physics/native"}
    assert settings["package-data"]["warpmpc.physics"] == ["native/*.h"]


def test_the_version_is_the_same_everywhere():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert warpmpc.__version__ == version
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_what_is_imported_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(line for extra in project["optional-dependencies"].values() for line in extra),
    ]
    declared = {re.match(r"[\w-]+", line)[0].replace("_", "-") for line in wanted}
    owners = importlib.metadata.packages_distributions()
    imported = {
        name for place in ("warpmpc", "kernels") for file in (ROOT / place).rglob("*.py") for name in _roots(file)
    }
    foreign = imported - set(sys.stdlib_module_names) - {"warpmpc", "pydantic_core"}  # which pydantic pins
    lacking = {  # packages of ROS begin with its name on PyPI
        name
        for name in foreign
        if not declared & {o.lower().replace("_", "-") for o in (name, f"ros-{name}", *owners.get(name, ()))}
    }
    assert {"mujoco", "numpy", "warp"} <= foreign
    assert lacking == set()


def _roots(file: Path) -> set[str]:
    """Top-level names of the packages that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {name.name.partition(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add(node.module.partition(".")[0])
    return found


BARE = """
import sys
from importlib.machinery import PathFinder

HIDDEN = ["matplotlib", "newton_usd_schemas", "onnxruntime", "pxr", "pyarrow", "ray", "rerun", "viser", "zmq"]
find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *place: None if name.partition(".")[0] in HIDDEN else find(name, *place)
from warpmpc.cli.main import main
sys.exit(main())
"""
"""The program in an environment that has none of the extras."""


def bare(folder: Path, *args: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", BARE, *args], cwd=folder, capture_output=True, text=True, timeout=280)


def test_the_main_job_needs_no_extra_and_its_folder_has_no_recording(tmp_path):
    short = ("--set", "timing.timeout=0.2", "--engine", "mujoco", "--device", "cpu")
    done = bare(tmp_path, "run", "omni_push_box", *short, "--out", "push")
    assert done.returncode == 1, done.stderr  # no push in 0.2 s
    assert "timeout" in done.stdout
    said = '--out: the folder gets no recording: a recording needs rerun: pip install "warpmpc[record]"'
    assert said in done.stderr.splitlines()
    assert sorted(file.name for file in (tmp_path / "push").iterdir()) == [
        "episode.runlog",
        "results.jsonl",
        "run.json",
        "scene.toml",
    ]


@pytest.mark.parametrize(
    ("arguments", "cure"),
    [
        (
            ("run", "omni_push_box", "--record", "a.rrd"),
            '--record: a recording needs rerun: pip install "warpmpc[record]"',
        ),
        (("check", "usd.toml"), 'robot.base.asset: a USD file needs usd-core: pip install "warpmpc[usd]"'),
        (("live", "omni_push_box"), "the page needs viser: pip install 'warpmpc[live]'"),
    ],
)
def test_what_needs_more_says_how_to_get_it(arguments, cure, tmp_path):
    (tmp_path / "base.usda").write_text("#usda 1.0\n")
    scene = (ROOT / "scenes" / "omni_push_box.toml").read_text().replace('"assets/omni_base.urdf"', '"base.usda"')
    (tmp_path / "usd.toml").write_text(scene)
    done = bare(tmp_path, *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert cure in done.stderr
    assert len(done.stderr.splitlines()) == 1
