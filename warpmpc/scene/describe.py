# SPDX-License-Identifier: Apache-2.0
"""The keys of scene files in words: what a key takes, in which unit, and what holds when it is left out."""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from .types import ONE_FOR_LIST

if TYPE_CHECKING:
    from pydantic import BaseModel as Section

_SIGNS = (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤"))
_BEYOND = 2**31 - 1
"""A bound that is the computer's own and worth no mention."""
_PLAIN = {bool: "true | false", str: "text", int: "whole number", float: "number", Path: "text"}
_UNIT = r"(?:m|rad|s|kg|N|degrees|1/|\(rad|\(m)"
_UNITS = re.compile(rf"\[({_UNIT}(?![a-z])[^\[\]]*)\]")


def takes(field: FieldInfo) -> str:
    """Type of a key in words: ``number > 0``, ``[text, text]``, ``table``."""
    return _words(field.annotation, field.metadata)


def _words(kind: object, metadata: Iterable[object] = ()) -> str:
    """A type in words, given what validates it besides."""
    if get_origin(kind) is Annotated:
        inner, *more = get_args(kind)
        return _words(inner, [*more, *metadata])
    if isinstance(kind, UnionType) or get_origin(kind) is Union:
        return " or ".join(dict.fromkeys(_words(part, metadata) for part in get_args(kind) if part is not NoneType))
    parts = get_args(kind)
    if get_origin(kind) is dict:
        one = _words(parts[1])
        return "tables by name" if one == "table" else f"table: name = {one}"
    if get_origin(kind) is tuple:
        return _list(parts, metadata)
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return "table"
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return " | ".join(kind)
    return _PLAIN.get(kind, "anything") + _bounds(metadata)


def _list(parts: tuple, metadata: Iterable[object]) -> str:
    one = [_words(part) for part in parts if part is not Ellipsis]
    if Ellipsis not in parts:
        return f"[{', '.join(one)}]"
    alone = f"{one[0]} or " if any(getattr(item, "func", None) in ONE_FOR_LIST for item in metadata) else ""
    return f"{alone}array of tables" if one == ["table"] else f"{alone}[{one[0]}, ...]"


def _bounds(metadata: Iterable[object]) -> str:
    """Bounds of a number, among them those that a ``Field`` keeps to itself."""
    items = [inner for item in metadata for inner in (getattr(item, "metadata", None) or [item])]
    found = {name: getattr(item, name) for item in items for name, _ in _SIGNS if hasattr(item, name)}
    bounds = [f" {sign} {found[name]:g}" for name, sign in _SIGNS if name in found and found[name] != _BEYOND]
    return " and".join(bounds)


def default(field: FieldInfo) -> str:
    """Default of a key, as a scene file would write it; ``required`` and ``-`` for nothing."""
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None or value is PydanticUndefined or value in ((), {}):
        return "-"
    if isinstance(value, BaseModel):  # what a section is when left out stands at its keys
        return "-" if takes(field) == "table" else written(value.model_dump(mode="json"))
    return written(value)


def written(value: object) -> str:
    """A value as a scene file would write it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(written, value))}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{name} = {written(item)}' for name, item in value.items())} }}"
    return f'"{value}"' if isinstance(value, str) else str(value)


def unit(field: FieldInfo) -> str:
    """The units that a key's meaning names in brackets, such as ``m or rad``; empty for numbers without."""
    return ", ".join(dict.fromkeys(_UNITS.findall(field.description or "")))


def keys(section: type[Section]) -> dict[str, FieldInfo]:
    """The keys that a scene file may give in a section."""
    return {name: field for name, field in section.model_fields.items() if not field.exclude}
