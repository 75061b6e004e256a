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
HIDDEN += ["gymnasium", "h5py", "onnx", "torch"]
find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *place: None if name.partition(".")[0] in HIDDEN else find(name, *place)
"""
"""An environment that has none of the extras."""
PROGRAM = (
    BARE
    + """
from warpmpc.cli.main import main
sys.exit(main())
"""
)
EXAMPLE = (
    BARE
    + """
import runpy
sys.path.insert(0, sys.argv[1].rpartition("/")[0])
runpy.run_path(sys.argv[1], run_name="__main__")
"""
)


def bare(folder: Path, *args: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *args], cwd=folder, capture_output=True, text=True, timeout=280
    )


def test_the_main_job_needs_no_extra_and_its_folder_has_no_recording(tmp_path):
    short = ("--set", "timing.timeout=0.2", "--set", "planner.samples=16", "--engine", "mujoco", "--device", "cpu")
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


@pytest.mark.parametrize("example", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.name)
def test_an_example_says_what_it_needs_and_without_it_ends_in_a_line(example):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    there = {re.match(r"[\w-]+", line)[0].removesuffix("-lang") for line in project["dependencies"]}
    beside = {file.stem for file in example.parent.glob("*.py")}
    needed = _roots(example) - set(sys.stdlib_module_names) - there - beside - {"warpmpc"}
    if not needed:
        return
    command = re.search(r"pip install [^;.]*", ast.get_docstring(ast.parse(example.read_text())))[0]
    extras = re.search(r"warpmpc\[([\w,]+)\]", command)[1].split(",")
    brought = " ".join(line for extra in extras for line in project["optional-dependencies"][extra])
    assert [name for name in needed if name not in f"{brought} {command.rpartition(']')[2]}"] == []
    done = subprocess.run([sys.executable, "-c", EXAMPLE, str(example)], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: {example.name} needs ")
    assert line.endswith(command)
