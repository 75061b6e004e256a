# SPDX-License-Identifier: Apache-2.0
"""Changes to a scene by key: variants, ``--set K=V`` and draws share one way to address a value.

Entries of arrays of tables are addressed by name (``robot.base.joint_q``, ``cost.distance.weight``), entries without
names by their place (``plant.kicks.0.time``), and ``*`` stands for every entry.
"""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING

from pydantic import ValidationError

from .errors import SceneError, entry_label, join_key
from .schema import Scene

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

Key = tuple[str, ...]

_PART = r"""\s*("[^"]+"|'[^']+'|[^."'\s]+)\s*"""

NAMED = ("robot", "object", "obstacle", "cost", "motion")
"""Arrays of tables at the top of a scene whose entries have names."""

RIVALS = {("planner",): ("horizon", "lookahead"), ("planner", "temperature"): ("ess", "eta")}
"""Keys of a table that say the same in two ways: a patch that has one takes the other away."""


def parse_override(text: str) -> tuple[Key, object]:
    """Read ``K=V``: a dotted key and a TOML value; a bare word is a string.

    Raises:
        SceneError: If the text has no key or no value, or the value is not TOML.
    """
    source = f"--set {text}"
    name, equals, value = text.partition("=")
    if not equals or not name.strip() or not value.strip():
        raise SceneError("must have the form KEY=VALUE", file=source, found=text)
    key = split_key(name, file=source)
    try:
        parsed = tomllib.loads(f"value = {value.strip()}")
        if list(parsed) == ["value"]:
            return key, parsed["value"]
    except (ValueError, RecursionError):
        word = value.strip()
        if re.fullmatch(r"(?:[A-Za-z_~/]|\.{1,2}/)[^\s\"'\[\]{},=]*", word):
            return key, word
    raise SceneError(
        "is not a TOML value", key=join_key(key), file=source, found=value.strip(), allowed="3, 0.5, true, word, [1, 2]"
    )


def split_key(text: str, *, file: object = None) -> Key:
    """Split a dotted key; parts in quotes may have their own dots.

    Raises:
        SceneError: If a part is empty.
    """
    if not re.fullmatch(rf"{_PART}(\.{_PART})*", text):
        raise SceneError(
            "is not a dotted key", file=file, found=text.strip(), allowed="robot.base.joint_q, cost.*.weight"
        )
    return tuple(part.strip("\"'") for part in re.findall(_PART, text))


def nest(key: Key, value: object) -> dict:
    """The tables in which a value stands under a key."""
    for part in reversed(key):
        value = {part: value}
    return value


def leaves(patch: dict, at: Key = ()) -> Iterator[Key]:
    """Keys of all values of nested tables."""
    for name, value in patch.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, (*at, name))
        else:
            yield (*at, name)


def merge(base: object, patch: object, at: Key = ()) -> object:
    """Lay a patch over data, table by table; anything that is not a table replaces what was there.

    Args:
        base: Data of a scene; not changed.
        patch: What to change. A table laid over an array of tables addresses its entries by name.
        at: Key of ``base`` in the scene, for messages.

    Returns:
        The changed data.

    Raises:
        SceneError: If the patch addresses an entry that does not exist, or several at once.
    """
    if not isinstance(patch, dict):
        return patch
    if base is None and len(at) == 1 and at[0] in NAMED:
        base = []
    if isinstance(base, list):
        return _merge_list(base, patch, at)
    if not isinstance(base, dict):
        base = {}
    merged = dict(base)
    rivals = RIVALS.get(at, ())
    if len(given := [name for name in rivals if name in patch]) == 1:
        merged = {name: value for name, value in merged.items() if name not in rivals or name in given}
    for name, value in patch.items():
        for key in list(base) if name == "*" else (name,):
            merged[key] = merge(merged.get(key), value, (*at, key))
    return merged


def _merge_list(base: list, patch: dict, at: Key) -> object:
    tables = all(isinstance(entry, dict) for entry in base)
    if not tables and not all(name.isdigit() for name in patch):
        return patch  # such as start coordinates by joint name instead of a list
    if tables and len(base) == 1 and entry_label(base[0], 0) == "0" and not patch.keys() & {"*", "0"}:
        return [merge(base[0], patch, at)]
    merged = list(base)
    for name, value in patch.items():
        for i in select(base, name, at):
            merged[i] = merge(merged[i], value, (*at, entry_label(merged[i], i)))
    return merged


def select(entries: list, name: str, at: Key) -> list[int]:
    """Places of the entries that a name addresses: all for ``*``, else exactly one.

    A name goes before a cost term: ``cost.distance`` is the entry with ``name = "distance"`` if there is one, else the
    one with ``term = "distance"``.

    Raises:
        SceneError: If no entry has the name, or several have.
    """
    if name == "*":
        return list(range(len(entries)))
    labels = [entry_label(entry, i) for i, entry in enumerate(entries)]
    by_name = [i for i, label in enumerate(labels) if label == name]
    by_term = [i for i, entry in enumerate(entries) if isinstance(entry, dict) and entry.get("term") == name]
    found = by_name or by_term
    if len(found) == 1:
        return found
    key = join_key((*at, name))
    if found:
        raise SceneError(
            f"{len(found)} entries of {join_key(at)} answer to this name: give each another name",
            key=key,
            found=name,
            allowed=sorted({labels[i] for i in found} - {name}) or None,
        )
    raise SceneError(f"no entry of {join_key(at)} has this name", key=key, found=name, allowed=labels)


def expand(data: object, key: Key, at: Key = ()) -> Iterator[Key]:
    """Every key that a key with ``*`` stands for, with the entries' own names.

    Raises:
        SceneError: If the key addresses an entry that does not exist.
    """
    if not key:
        yield at
        return
    name, rest = key[0], key[1:]
    if data is None and len(at) == 1 and at[0] in NAMED:
        data = []
    if isinstance(data, list) and all(isinstance(entry, dict) for entry in data):
        if len(data) == 1 and entry_label(data[0], 0) == "0" and name not in ("*", "0"):
            yield from expand(data[0], key, at)
            return
        for i in select(data, name, at):
            yield from expand(data[i], rest, (*at, entry_label(data[i], i)))
    elif isinstance(data, dict):
        for each in data if name == "*" else (name,):
            yield from expand(data.get(each), rest, (*at, each))
    else:
        yield (*at, *key)


def with_values(scene: Scene, values: Mapping[str, object]) -> Scene:
    """Change a scene by keys as in ``--set``, with Python values, and validate it again.

    Args:
        scene: Scene to start from.
        values: Dotted key → value.

    Returns:
        A new scene.

    Raises:
        SceneError: If a key does not exist or a value does not fit.
    """
    # keys that are not set follow from those that are, such as the presets of a method
    data = scene.model_dump(mode="json", exclude_unset=True)
    for key, value in values.items():
        data = merge(data, nest(split_key(key), value))
    return validated(data, file=scene.path).model_copy(update={"path": scene.path, "variant": scene.variant})


def validated(data: object, *, file: Path | str | None = None) -> Scene:
    """Validate plain data as a scene.

    Raises:
        SceneError: If it is none.
    """
    try:
        return Scene.model_validate(data)
    except ValidationError as error:
        raise SceneError.from_validation(error, data, Scene, file=file) from None
