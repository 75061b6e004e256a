# SPDX-License-Identifier: Apache-2.0
"""Which state of warpmpc made a result, and from which scene."""

from __future__ import annotations

import hashlib
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ..model.assets import resolve_asset
from ..model.compiled import files_of

if TYPE_CHECKING:
    from ..scene.schema import Scene


def code_digest() -> str:
    """Hash of the sources of warpmpc and its kernels, so that results of several states of them can be told apart.

    It is the same wherever the sources lie, in a checkout or installed.
    """
    package = Path(__file__).parents[1]
    kernels = Path(importlib.util.find_spec("warpmpc.kernels").origin).parent
    found = {name: file for name, file in _sources(package) if name.parts[0] != "kernels"}
    found |= {"kernels" / name: file for name, file in _sources(kernels)}
    digest = hashlib.sha256()
    for name in sorted(found):
        digest.update(name.as_posix().encode() + found[name].read_bytes())
    return digest.hexdigest()[:12]


def scene_digest(scene: Scene) -> str:
    """Hash of a scene's validated content and of what its assets and files of motions hold, wherever they lie.

    Raises:
        SceneError: If an asset cannot be found.
    """
    digest = hashlib.sha256(scene.model_dump_json().encode())
    for file in (*files_of(scene), *_tried(scene)):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _tried(scene: Scene) -> Iterator[Path]:
    """Files of what is tried among the samples."""
    base, planner = (scene.path.parent if scene.path else None), scene.planner
    for name in (planner.sequences, *(ancillary.file for ancillary in planner.ancillary)):
        if name is not None:
            yield resolve_asset(name, base=base, key="planner", file=scene.path)


def _sources(root: Path) -> Iterator[tuple[Path, Path]]:
    """Every source below a folder: its name there, and the file."""
    for folder, _, files in os.walk(root, followlinks=True):
        for file in files:
            if file.endswith((".py", ".h")):
                path = Path(folder) / file
                yield path.relative_to(root), path
