# SPDX-License-Identifier: Apache-2.0
"""Digest of the scene that made a result."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ..model.assets import resolve_asset
from ..model.compiled import files_of

if TYPE_CHECKING:
    from ..scene.schema import Scene


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
