# SPDX-License-Identifier: Apache-2.0
"""Tuned values into a scene's file; comments and order stay."""

from __future__ import annotations

import os
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..scene.load import load_scene
from ..scene.overrides import split_key


def save(path: Path, labels: Sequence[str], tuned: Mapping[str, float], planner: Mapping[str, str]) -> None:
    """Write tuned values into a scene's file, once the result is known to be a scene.

    Args:
        path: The scene's file.
        labels: Names of its cost terms, in order.
        tuned: Weights and scalars by name.
        planner: TOML values by dotted key of the scene.

    Raises:
        SceneError: If the result would not be a scene; the file stays as it was.
        OSError: If it cannot be written.
    """
    import tomlkit

    document = tomlkit.parse(path.read_text(encoding="utf-8"))
    for name, value in tuned.items():
        if name in labels:
            _put(document["cost"][list(labels).index(name)], "weight", float(f"{value:.6g}"))
        else:
            _put(document["scalar"], name, float(f"{value:.6g}"))
    for key, text in planner.items():
        *tables, last = split_key(key)
        table = document
        for part in tables:
            if part not in table:
                table[part] = tomlkit.table() if table is document else tomlkit.inline_table()
            table = table[part]
        _put(table, last, tomllib.loads(f"value = {text}")["value"])
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}_", suffix=".toml")  # assets are beside it
    written = Path(name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(tomlkit.dumps(document))
        written.chmod(path.stat().st_mode)
        load_scene(written)
        written.replace(path)
    finally:
        written.unlink(missing_ok=True)


def _put(table: object, key: str, value: object) -> None:
    """Set a value; the comment behind an earlier one stays."""
    import tomlkit

    item = tomlkit.item(value)
    if key in table and hasattr(table.item(key) if hasattr(table, "item") else table[key], "trivia"):
        old = table.item(key) if hasattr(table, "item") else table[key]
        item.trivia.indent, item.trivia.comment_ws = old.trivia.indent, old.trivia.comment_ws
        item.trivia.comment, item.trivia.trail = old.trivia.comment, old.trivia.trail
    table[key] = item
