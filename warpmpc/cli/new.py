# SPDX-License-Identifier: Apache-2.0
"""``warpmpc new``: a folder with a scene, a robot, a cost term and a loop that run as they are."""

from __future__ import annotations

import shutil
from pathlib import Path

STARTER = Path(__file__).parent / "starter"
"""The files, but for the schema, which is that of this version."""
SCHEMA = "scene.schema.json"


def make_starter(folder: Path) -> list[str]:
    """Write the starter into a new or empty folder.

    Args:
        folder: Where; it is made if there is none.

    Returns:
        The names of the files.

    Raises:
        ValueError: If there is something in the way.
        OSError: If it cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: is a file; name a folder that is empty or not there yet")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder}: is not empty; name a folder that is empty or not there yet")
    from .schema import schema_text  # slow to import: a folder in the way is told at once

    folder.mkdir(parents=True, exist_ok=True)
    names = sorted(file.name for file in STARTER.iterdir() if file.is_file())
    for name in names:
        shutil.copyfile(STARTER / name, folder / name)
    (folder / SCHEMA).write_text(schema_text(), encoding="utf-8")
    return [*names, SCHEMA]
