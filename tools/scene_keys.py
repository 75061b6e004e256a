# SPDX-License-Identifier: Apache-2.0
"""What a scene's keys hold at present, for tools that change them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warpmpc.scene.errors import entry_label, join_key
from warpmpc.scene.overrides import (
    expand,
    parse_override,
    select,
    split_key,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warpmpc import Scene
    from warpmpc.scene.overrides import Key


def present(scene: Scene, key: str) -> dict[str, object]:
    """Full keys that a key as in ``--set`` stands for, with their values as plain data; those not set are left out.

    Raises:
        SceneError: If the key addresses an entry that does not exist.
    """
    data = scene.model_dump(mode="json")
    found = {}
    for full in expand(data, split_key(key)):
        try:
            found[join_key(full)] = _value(data, full)
        except (KeyError, IndexError, TypeError, ValueError):
            continue  # nothing there
    return found


def _value(data: object, key: Key) -> object:
    for depth, part in enumerate(key):
        if isinstance(data, list):
            if not all(isinstance(entry, dict) for entry in data):
                data = data[int(part)]
                continue
            if len(data) == 1 and entry_label(data[0], 0) == "0" and part != "0":
                data = data[0][part]  # the one entry of an array of tables needs no number
                continue
            data = data[select(data, part, key[:depth])[0]]
        else:
            data = data[part]
    return data


def spread(scene: Scene, overrides: Sequence[str]) -> tuple[str, ...]:
    """Overrides whose ``*`` stands only for entries that have the key, so that ``cost.*.metric`` skips other terms.

    Raises:
        ValueError: If no entry has the key.
        SceneError: If a key or value cannot be read.
    """
    out = []
    for text in overrides:
        key, _ = parse_override(text)
        if "*" not in key:
            out.append(text)
            continue
        name, _, value = text.partition("=")
        if not (keys := present(scene, name)):
            raise ValueError(f"--set {text}: no entry of {scene.name} has this key")
        out += [f"{full}={value}" for full in keys]
    return tuple(out)
