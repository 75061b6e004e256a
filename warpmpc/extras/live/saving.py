# SPDX-License-Identifier: Apache-2.0
"""Changes written into a scene's file; comments and order stay."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...physics.runtime.files import writing
from ...scene.errors import SceneError, entry_label, join_key
from ...scene.load import load_scene, shipped_folder, split_variant
from ...scene.model.compiled import compile_scene
from ...scene.overrides import Key, expand, leaves, merge, nest, parse_override, select


def values_of(labels: Sequence[str], tuned: Mapping[str, float]) -> list[str]:
    """``KEY=VALUE`` texts of weights and scalars.

    Args:
        labels: Names of the scene's cost terms.
        tuned: Weights and scalars by name.
    """
    keys = {n: join_key(("cost", n, "weight") if n in labels else ("scalar", n)) for n in tuned}
    return [f"{keys[name]}={value:.6g}" for name, value in tuned.items()]


def place_of(path: Path) -> Path:
    """The file to save a scene to: its own, but one in the working directory for a scene that comes with warpmpc."""
    if not path.resolve().is_relative_to(shipped_folder().resolve()):
        return path
    names = (f"{path.stem}_tuned{n or ''}.toml" for n in [0, *range(2, 1000)])
    return next(file for file in map(Path.cwd().joinpath, names) if not file.exists())


def save(path: Path, variant: str | None, texts: Sequence[str], *, to: Path) -> None:
    """Write changes into a copy of a scene's file, or into the file, once the result is known to be what runs.

    What the variant says of a key is changed in the variant, everything else in the scene. Of a symbolic
    link the target is written; the link stays.

    Args:
        path: The scene's file.
        variant: Its variant that runs, None for none.
        texts: Changes ``KEY=VALUE``, in order.
        to: File to write.

    Raises:
        SceneError: If the result would not be the scene that runs, or would not compile; nothing is written.
        Unwritable: If it cannot be written.
    """
    text = edited(path, variant, texts)
    file, ending = to.resolve(), "" if variant is None else f":{variant}"
    with writing(to):
        handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{to.stem}_"[:100], suffix=".toml")
    written = Path(name)
    tried = to.with_name(written.name)  # assets are beside the link, if it is one
    try:
        with writing(to), os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
        if not tried.exists():
            tried.symlink_to(written)
        saved, wanted = load_scene(f"{tried}{ending}"), load_scene(f"{path}{ending}", overrides=texts)
        if saved.model_dump(exclude={"path"}) != wanted.model_dump(exclude={"path"}):
            raise SceneError("the saved file would not be the scene that runs: change it by hand", file=path)
        compile_scene(saved)
        with writing(to):
            written.chmod((file if file.exists() else path).stat().st_mode | 0o200)
            written.replace(file)
    finally:
        tried.unlink(missing_ok=True)
        written.unlink(missing_ok=True)


def edited(path: Path, variant: str | None, texts: Sequence[str]) -> str:
    """The text of a scene's file with changes, as :func:`save` writes it."""
    import tomlkit

    document = tomlkit.parse(path.read_text(encoding="utf-8-sig"))
    data = document.unwrap()
    patches = data.pop("variants", {})
    varied: dict[Key, str] = {}
    for name in split_variant(variant):
        patch = patches.get(name, {})
        varied |= {full: name for leaf in leaves(patch) for full in expand(data, leaf)}
        data = merge(data, patch)
    for key, value in _changes(data, texts):
        inside = [name for other, name in varied.items() if all(a == b for a, b in zip(key, other, strict=False))]
        _put(document["variants"][inside[-1]] if inside else document, key, value)
        data = merge(data, nest(key, value))
    return tomlkit.dumps(document)


def _changes(data: dict, texts: Sequence[str]) -> Iterator[tuple[Key, object]]:
    """Full key and value of everything that is changed, entry by entry."""
    for text in texts:
        key, value = parse_override(text)
        for full in expand(data, key):
            if isinstance(value, dict):
                nested = nest(full, value)
                for leaf in leaves(nested):
                    yield leaf, _at(nested, leaf)
            else:
                yield full, value


def _at(data: Any, key: Key) -> object:
    for part in key:
        data = data[part]
    return data


def _put(at: Any, key: Key, value: object) -> None:
    """Set a value below a table or an array of tables of a document; what is not there yet is added."""
    import tomlkit

    name, *rest = key
    if isinstance(at, list):
        entries = at.unwrap()
        if len(entries) == 1 and name != "0" and entry_label(entries[0], 0) == "0":
            _put(at[0], key, value)
        else:
            _put(at[select(entries, name, ())[0]], tuple(rest), value)
    elif rest and name in at and isinstance(at[name], dict | list):
        _put(at[name], tuple(rest), value)
    elif rest and isinstance(at, tomlkit.TOMLDocument):
        at[name] = tomlkit.table()  # a dotted key at the end would belong to the last table
        _put(at[name], tuple(rest), value)
    elif rest:
        if name in at:
            del at[name]
        at.append(tomlkit.key(list(key)), tomlkit.item(value))
    else:
        _replace(at, name, value)


def _replace(table: Any, key: str, value: object) -> None:
    """Set a value; the comment behind an earlier one stays."""
    import tomlkit

    item = tomlkit.item(value)
    if key in table:
        old = table.item(key) if hasattr(table, "item") else table[key]
        if hasattr(old, "trivia"):
            item.trivia.indent, item.trivia.comment_ws = old.trivia.indent, old.trivia.comment_ws
            item.trivia.comment, item.trivia.trail = old.trivia.comment, old.trivia.trail
    table[key] = item
