# SPDX-License-Identifier: Apache-2.0
"""A folder that tells all about a run: scene, command, seeds, versions, hardware, results, logs, recordings."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..physics.runtime.files import append_line, writing

if TYPE_CHECKING:
    from ..scene.schema import Scene

ABOUT, SCENE, RESULTS = "run.json", "scene.toml", "results.jsonl"
LOG, RECORDING, TERMS = "episode.runlog", "recording.rrd", "terms"


class RunFolder:
    """Writes the folder of a run.

    Args:
        path: The folder; made if it is not there, else it must be empty.
        scene: The scene as it is used, variant and changes applied, its tasks not drawn yet.
        term_files: Python files of cost terms; they are copied.
        asked: What else was asked for, such as the engine, as plain data.

    Raises:
        ValueError: If the folder is another run's.
        Unwritable: If something cannot be written.
    """

    def __init__(
        self, path: Path, scene: Scene, *, seeds: Sequence[int], term_files: Sequence[Path], asked: dict[str, Any]
    ):
        from ..scene.load import dump_scene
        from ..scene.origin import origin

        self._path = path
        about = {
            "command": shlex.join(["warpmpc", *sys.argv[1:]]),
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "scene": scene.name,
            "variant": scene.variant,
            "file": None if scene.path is None else str(scene.path),
            "seeds": list(seeds),
            **asked,
            **origin(),
        }
        text = json.dumps(about, indent=2, ensure_ascii=False)
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
            try:
                with open(path / ABOUT, "x", encoding="utf-8") as file:  # first: of two runs one gets the folder
                    file.write(text + "\n")
            except FileExistsError:
                raise ValueError(f"--out: '{path}' is another run's: give a new folder for each run") from None
            (path / SCENE).write_text(dump_scene(scene), encoding="utf-8")
            for i, file in enumerate(term_files):
                (path / TERMS).mkdir(exist_ok=True)
                shutil.copy(file, path / TERMS / f"{i}_{file.name}")

    def end(self) -> None:
        """Remove what was written at the start where no episode began, so that the folder is free for the next try."""
        begun = [file for file in self._path.rglob("*") if file.is_file()]
        if all(file.name in (ABOUT, SCENE) or file.parent.name == TERMS for file in begun):
            for file in begun:
                file.unlink()
            for folder in (self._path / TERMS, self._path):
                with suppress(OSError):
                    folder.rmdir()

    def add(self, result: dict[str, Any]) -> None:
        """Add the result of an episode, as data for JSON; it is on disk when this returns.

        Raises:
            Unwritable: If it cannot be written.
        """
        append_line(self._path / RESULTS, json.dumps(result, ensure_ascii=False, allow_nan=False).encode())


def check_folder(path: Path) -> None:
    """Refuse a folder that holds something, so that no result is mixed with another.

    Raises:
        ValueError: If it does, or is a file.
    """
    if os.path.lexists(path) and not path.is_dir():
        raise ValueError(f"--out: '{path}' is a file: give a folder for the run")
    if path.is_dir() and any(path.iterdir()):
        raise ValueError(f"--out: '{path}' is not empty: give a new folder for each run")


def logs_in(path: Path) -> list[Path]:
    """Run logs that a path means: those of a run's folder, or the file itself.

    Raises:
        ValueError: If there are none.
    """
    if not path.is_dir():
        return [path]
    stem, suffix = LOG.split(".")
    found = [*path.glob(LOG), *path.glob(f"{stem}-*.{suffix}")]
    if not found:
        raise ValueError(f"{path}: no run's folder: there is no {LOG} in it; `warpmpc run SCENE --out DIR` makes one")
    return sorted(found, key=lambda file: (len(file.name), file.name))


def results_in(path: Path) -> dict[int, dict[str, Any]]:
    """Results of the episodes of a run's folder by seed, as data from JSON; none for a file.

    Raises:
        ValueError: If their file is damaged.
    """
    file = path / RESULTS
    if not file.is_file():
        return {}
    try:
        found = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        return {result["seed"]: result for result in found}
    except (ValueError, TypeError, KeyError):
        raise ValueError(f"{file}: has no results of episodes, one JSON object a line") from None


def terms_in(path: Path) -> list[Path]:
    """Files of users' terms that a run's folder holds; none for a file."""
    return sorted((path / TERMS).glob("*.py"), key=lambda file: (file.name.find("_"), file.name))
