# SPDX-License-Identifier: Apache-2.0
"""Every file that a robot's asset is read from: the asset, what it includes, its meshes, textures and height fields."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from .assets import AssetKind, asset_kind, find_mesh

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_FOLDERS = ("meshdir", "texturedir", "assetdir")
"""Attributes of an MJCF file's ``<compiler>`` that say where its files lie."""


def asset_files(path: Path) -> list[Path]:
    """The files that a URDF or MJCF asset is read from, as far as they exist, the asset first.

    Raises:
        SceneError: If it is no XML.
    """
    path = path.absolute()
    found = _of_mjcf(path) if asset_kind(path) is AssetKind.MJCF else [path, *_of_urdf(path)]
    return list(dict.fromkeys(found))


def _of_urdf(path: Path) -> Iterator[Path]:
    for name in re.findall(r'filename\s*=\s*["\']([^"\']+)["\']', path.read_text(errors="replace")):
        if file := find_mesh(name, path):
            yield file


def _of_mjcf(path: Path) -> list[Path]:
    """The XML files first, then what they name; MuJoCo looks for both from the folder of the first file, too."""
    texts, waiting, folders, names = [], [path], [path.parent], []
    while waiting:
        text = waiting.pop()
        if text in texts or not text.is_file():
            continue
        texts.append(text)
        try:
            root = ElementTree.parse(text).getroot()
        except ElementTree.ParseError:
            continue  # whoever reads the asset says so
        for element in root.iter():
            if element.tag == "include" or (element.tag == "model" and element.get("file")):
                waiting += [folder / element.get("file", "") for folder in (path.parent, text.parent)]
            elif element.tag == "compiler":
                given = [element.get(attribute) for attribute in _FOLDERS]
                folders += [base / folder for base in (path.parent, text.parent) for folder in given if folder]
            else:
                names += [value for key, value in element.items() if key.startswith("file")]
        folders.append(text.parent)
    found = [folder / name for name in names for folder in folders if (folder / name).is_file()]
    return texts + found
