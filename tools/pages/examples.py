# SPDX-License-Identifier: Apache-2.0
"""An example of every key of scene files, found in the scenes that ship, in the documentation, or among examples."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import get_args

from pydantic import BaseModel

from warpmpc import Scene, shipped_scenes
from warpmpc.cli.lists import EXAMPLES
from warpmpc.cost.terms import TERMS
from warpmpc.scene.describe import keys, takes, written

ROOT = Path(__file__).parents[2]
LONGEST = 90
"""Longer examples [characters] are taken where there is no shorter one."""

Examples = dict[tuple[type[BaseModel], str], str]
"""What may stand behind a key of a section, as a scene file writes it."""


def examples() -> Examples:
    """An example for every key of every section that has one anywhere, the first that is not too long."""
    found: Examples = {}
    for data in _sources():
        for section, key, value in _entries(Scene, data):
            text = written(value)
            old = found.get((section, key))
            if old is None or (len(text) < len(old) and len(old) > LONGEST):
                found[section, key] = text
    return found


def _sources() -> Iterator[dict]:
    """Scenes and parts of scenes, the ones people know first."""
    for path in shipped_scenes().values():
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        variants = data.pop("variants", {})
        yield data
        yield from variants.values()
    for page in sorted(ROOT.glob("docs/**/*.md")):
        blocks = re.findall(r"^```toml[^\n]*\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
        yield from map(tomllib.loads, blocks)
    yield tomllib.loads(EXAMPLES.read_text(encoding="utf-8"))


def _entries(section: type[BaseModel], data: object) -> Iterator[tuple[type[BaseModel], str, object]]:
    """Every key in a section of a file and below, with the type of the section that it is in."""
    if not isinstance(data, Mapping):
        return
    known = keys(section)
    for key, value in data.items():
        if key not in known or (value is False and takes(known[key]) != "true | false"):
            continue
        inner = next(_sections(known[key].annotation), None)
        if inner is None:
            yield section, key, value
            continue
        for entry in _tables(value, inner):
            yield from _entries(inner, entry)
            if key == "cost" and entry.get("term") in TERMS:
                yield from _entries(TERMS[entry["term"]].keys, entry)
        if not _tables(value, inner):
            yield section, key, value


def _tables(value: object, section: type[BaseModel]) -> list[Mapping]:
    """The tables behind a key: one, several, or some by name."""
    if isinstance(value, Mapping):
        named = all(isinstance(entry, Mapping) for entry in value.values())
        return list(value.values()) if named and not value.keys() & section.model_fields.keys() else [value]
    return [entry for entry in value if isinstance(entry, Mapping)] if isinstance(value, list) else []


def _sections(kind: object) -> Iterator[type[BaseModel]]:
    """The sections in a type such as ``tuple[Robot, ...] | None``."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        yield kind
    for part in get_args(kind):
        yield from _sections(part)
