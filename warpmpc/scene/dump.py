# SPDX-License-Identifier: Apache-2.0
"""A scene as the text of a scene file, complete: variant and changes applied, every key written out."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from .load import check_scene, shipped_folder
from .overrides import validated
from .schema import Scene


def dump_scene(scene: Scene) -> str:
    """The text of a scene file that says all of a scene, defaults included.

    Files that lie beside the scene are named by their absolute paths, except those that ship with warpmpc.
    """
    import tomlkit  # slow to import

    data = scene.model_dump(mode="json", exclude_none=True, exclude={"path", "variant"})
    if scene.ground is None:
        data["ground"] = False
    if scene.path is not None and scene.path.parent != shipped_folder():
        data = _placed(data, scene.path.parent)
    return tomlkit.dumps(data)


def parse_scene(text: str, *, path: Path | None = None, variant: str | None = None) -> Scene:
    """The scene that :func:`dump_scene` wrote.

    Args:
        text: Text of the scene file.
        path: The file that the scene was made from, for its name.
        variant: The variant that was applied.

    Raises:
        SceneError: If it is no scene of this warpmpc.
    """
    scene = validated(tomllib.loads(text), file=path).model_copy(update={"path": path, "variant": variant})
    check_scene(scene)
    return scene


def _placed(value: Any, folder: Path) -> Any:
    """The same data with names of files in a folder made absolute."""
    if isinstance(value, dict):
        return {key: _placed(item, folder) for key, item in value.items()}
    if isinstance(value, list):
        return [_placed(item, folder) for item in value]
    if isinstance(value, str) and Path(value).suffix and (folder / value).is_file():
        return str((folder / value).absolute())
    return value
