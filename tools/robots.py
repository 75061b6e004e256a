#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Load every robot of the PyPI packages example-robot-data and mjlab and write a table of what came of it.

    python tools/robots.py docs/robots.md --keep rows.jsonl

Each robot stands alone in a scene without a floor, its root as its file has it; URDF files get a drive of 1 N·m on
every joint, and so do MJCF files without actuators. A plan has 8 samples; compiling the
engine and the costs for every robot takes long, which ``--engine none`` saves.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from warpmpc import Controller, Plant, Scene, SceneError
from warpmpc.scene.model.assets import package_dirs
from warpmpc.scene.model.compiled import compile_scene

PACKAGES = ("example-robot-data", "mjlab")
VERSIONS = (*PACKAGES, "warpmpc", "newton", "mujoco")
TEXT = 40
"""Longest text of a cell."""


@dataclass(frozen=True)
class Row:
    """What came of one robot."""

    package: str
    file: str
    """Path within its package."""
    loads: bool = False
    dof: int = 0
    engine: str = ""
    """Engine of the plan that ran; empty where none was tried."""
    repaired: tuple[str, ...] = ()
    error: str = ""
    """Why it does not load or plan."""
    refused: bool = True
    """Whether that is a ``SceneError``."""


def robots() -> list[tuple[str, Path, Path]]:
    """The robots of the packages that are installed: package, its folder, file."""
    found = []
    for folder in package_dirs():
        root = folder / "example-robot-data" / "robots"
        found += [(PACKAGES[0], root, path) for path in sorted(root.rglob("*.urdf"))]
    if spec := importlib.util.find_spec("mjlab"):
        root = Path(spec.submodule_search_locations[0])
        files = [*root.glob("asset_zoo/robots/*/xmls/*.xml"), *root.glob("tasks/*/*.xml")]
        found += [(PACKAGES[1], root, path) for path in sorted(files)]
    return found


def scene_of(path: Path) -> Scene:
    """A scene of one robot, which is to stand still."""
    robot = {"name": "robot", "asset": str(path)}
    if path.suffix == ".urdf" or "<actuator" not in path.read_text(encoding="utf-8"):
        robot["drive"] = [{"mode": "effort", "limit": [1.0]}]
    return Scene.model_validate(
        {
            "timing": {"control_dt": 0.02, "timeout": 1.0},
            "ground": False,
            "robot": [robot],
            "cost": [{"term": "joint_velocity"}],
            "planner": {"samples": 8, "horizon": 4, "noise": {"sigma": [0.1]}},
            "success": {"conditions": {"term": "joint_velocity", "below": 1e-9}},
        }
    )


def try_robot(package: str, root: Path, path: Path, *, engine: str | None = None) -> Row:
    """Load one robot.

    Args:
        package: Package it comes from.
        root: Folder of the package.
        path: Its file.
        engine: Engine to plan with, such as ``auto``; none if None.
    """
    known = {"package": package, "file": str(path.relative_to(root))}
    try:
        scene = scene_of(path)
        compiled = compile_scene(scene)
        compiled.spec().compile()
        repaired = tuple(line.removeprefix("robot: ") for line in compiled.repaired)
        known |= {"loads": True, "dof": compiled.layout.nv, "repaired": repaired}
        if engine:
            controller = Controller(scene, engine=engine)
            command = controller.step(Plant(scene, task=controller.task).observe())
            if not np.isfinite(command).all():
                raise FloatingPointError("the command is not finite")
            known["engine"] = controller.engine.name
    except Exception as error:  # whatever is raised is what the table is about
        said = error.message if isinstance(error, SceneError) else f"{type(error).__name__}: {error}"
        known |= {"error": " ".join(said.split()), "refused": isinstance(error, SceneError)}
    return Row(**known)


def table(rows: list[Row], roots: dict[str, Path]) -> str:
    """The rows as Markdown, paths of this machine left out."""

    def short(text: str) -> str:
        for root in roots.values():
            text = text.replace(f"{root}/", "").replace(f"{root.parent.parent}/", "")
        text = text.replace("|", "/")
        return text if len(text) <= TEXT else f"{text[: TEXT - 3]}..."

    lines = [
        "|robot|DoF|what was repaired, or why it is refused|",
        "|---|---|---|",
    ]
    for row in rows:
        more = f" (and {len(row.repaired) - 1} more)" if len(row.repaired) > 1 else ""
        said = short(row.error) if row.error else short(row.repaired[0]) + more if row.repaired else ""
        lines.append(f"|{row.file}|{row.dof if row.loads else '-'}|{said}|")
    return "\n".join(lines)


def page(rows: list[Row], roots: dict[str, Path], engine: str) -> str:
    """The page of all robots, planned for with an engine."""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in VERSIONS if _installed(name))
    loads, plans, repaired = (
        sum(map(bool, found)) for found in zip(*((r.loads, r.engine, r.repaired) for r in rows), strict=True)
    )
    parts = [
        "# Robots: what loads",
        f"Every robot of the PyPI packages example-robot-data and mjlab, written by `tools/robots.py` with {versions}.",
        f"{loads} of {len(rows)} load, {repaired} of them repaired with a warning; a plan was made with {plans}. Each "
        "stands alone in a scene without a floor, with a drive on every joint where its file brings no actuators. "
        f"A plan has 8 samples (`--engine {engine}`, on a CPU of {os.cpu_count()} cores).",
    ]
    for package in roots:
        parts += [f"## {package}", table([row for row in rows if row.package == package], roots)]
    return "\n\n".join(parts) + "\n"


def _installed(name: str) -> bool:
    try:
        return bool(importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return False


def main() -> None:
    """Try all robots and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, help="Markdown file to write")
    parser.add_argument("--keep", type=Path, help="file of rows to go on from, which takes new ones")
    parser.add_argument("--engine", default="auto", help="engine to plan with; none: load only")
    args = parser.parse_args()
    rows = []
    if args.keep and args.keep.is_file():
        rows = [Row(**json.loads(line)) for line in args.keep.read_text(encoding="utf-8").splitlines()]
    done = {(row.package, row.file) for row in rows}
    every = robots()
    for package, root, path in every:
        if (package, str(path.relative_to(root))) in done:
            continue
        rows.append(try_robot(package, root, path, engine=None if args.engine == "none" else args.engine))
        print(rows[-1], flush=True)
        if args.keep:
            with args.keep.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(rows[-1])) + "\n")
    rows.sort(key=lambda row: (PACKAGES.index(row.package), row.file))
    args.page.write_text(page(rows, {package: root for package, root, _ in every}, args.engine), encoding="utf-8")


if __name__ == "__main__":
    main()
