# SPDX-License-Identifier: Apache-2.0
"""The one error a user sees when a scene is wrong."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from typing import TYPE_CHECKING, get_args, get_origin

from pydantic import BaseModel

from .registry import Name
from .types import described

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from pydantic import ValidationError

_WANTED = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "string_type": "must be text in quotes",
    "bool_type": "must be true or false",
    "dict_type": "must be a table",
    "model_type": "must be a table",
    "finite_number": "must be finite, neither nan nor inf",
    "greater_than": "must be above {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than": "must be below {lt}",
    "less_than_equal": "must be at most {le}",
    "string_pattern_mismatch": "a name has letters, digits, _ and - only, and starts with a letter or _",
}
"""Pydantic's kinds of error in plain words; ``{...}`` is filled from the error's context."""

SHORT = 90
"""Longest meaning of a key that an error says beside its name [characters]."""
MOST = 10
"""Mistakes that an error lists."""
MISSING = "this key is missing"
_ALLOWED = {"bool_type": ("true", "false")}


class SceneError(ValueError):
    """A mistake in a scene: which file, which key, what was found, what is allowed and how to correct it.

    Where several were found, the text has a line for each.

    Args:
        message: What is wrong, in one sentence.
        key: Dotted key of the scene (``robot.base.drive.limit``).
        file: Scene file, when the scene came from one.
        found: The offending value.
        allowed: What may stand there instead, as a phrase or as the allowed names. With names, the nearest one to
            ``found`` is suggested, with what it means where ``allowed`` maps names to meanings.
        others: Further mistakes that were found.
    """

    def __init__(
        self,
        message: str,
        *,
        key: str | None = None,
        file: Path | str | None = None,
        found: object = None,
        allowed: str | Iterable[str] | Mapping[str, object] | None = None,
        others: Sequence[SceneError] = (),
    ):
        self.message, self.key, self.file, self.found, self.others = message, key, file, found, tuple(others)
        self.allowed = allowed if isinstance(allowed, str) or allowed is None else sorted(map(str, allowed))
        self.meanings = dict(allowed) if isinstance(allowed, Mapping) else {}
        super().__init__(str(self))

    @property
    def suggestion(self) -> str | None:
        """The allowed name nearest to what was found, if any is near."""
        if isinstance(self.allowed, list) and isinstance(self.found, str):
            spelled = {name.lower(): name for name in self.allowed}
            near = difflib.get_close_matches(self.found.lower(), spelled, n=1, cutoff=0.5)
            return spelled[near[0]] if near else None
        return None

    @property
    def each(self) -> tuple[SceneError, ...]:
        """All mistakes that were found, this one first."""
        return (self, *self.others)

    def __str__(self) -> str:
        lines = [error.line for error in self.each]
        more = len(lines) - MOST
        return "\n".join([*lines[:MOST], f"and {more} more mistake{'s' * (more > 1)}"] if more > 0 else lines)

    @property
    def line(self) -> str:
        """The text of this mistake alone."""
        where = ": ".join(str(part) for part in (self.file, self.key) if part is not None)
        text = f"{where}: {self.message}" if where else self.message
        if self.found is not None:
            text += f"; found {_shown(self.found)}"
        if isinstance(self.allowed, str):
            text += f"; allowed: {self.allowed}"
        elif self.allowed is not None:
            text += f"; allowed: {', '.join(self.allowed) if self.allowed else 'nothing, there is none'}"
        if self.suggestion:
            text += f". Did you mean {self.suggestion!r}?{_meaning(self.meanings.get(self.suggestion))}"
        return text

    @classmethod
    def from_validation(
        cls, error: ValidationError, data: object, root: type[BaseModel], *, file: Path | str | None = None
    ) -> SceneError:
        """Put a failed validation into plain words.

        Args:
            error: What pydantic found.
            data: The data that was validated.
            root: The model it was validated against.
            file: Scene file.

        Returns:
            All mistakes, the most telling first: unknown keys, as they tend to cause the others. A key that is missing
            where an unknown one is nearly the same is none.
        """
        rank = {"extra_forbidden": 0, "missing": 2}
        details = [detail for detail in error.errors(include_url=False) if not _is_echo(detail)]
        details.sort(key=lambda detail: rank.get(detail["type"], 1))
        found = [cls(**_explain(detail, data, root), file=file) for detail in details]
        meant = {f"{(e.key or '').rpartition('.')[0]}.{e.suggestion}" for e in found if e.suggestion}
        return cls.of([e for e in found if e.message != MISSING or e.key not in meant])

    @classmethod
    def of(cls, errors: Sequence[SceneError]) -> SceneError:
        """The first of several mistakes, with the others behind it."""
        first, *others = [each for error in errors for each in error.each]
        first.others = tuple(others)
        first.args = (str(first),)
        return first


class Mistakes:
    """Mistakes of several parts, raised together."""

    def __init__(self) -> None:
        self.found: list[SceneError] = []

    @contextmanager
    def of_part(self) -> Iterator[None]:
        """Keep the mistake of one part, and go on with the next."""
        try:
            yield
        except SceneError as error:
            self.found.append(error)

    def raise_all(self) -> None:
        """Raise what was found.

        Raises:
            SceneError: If there is any.
        """
        if self.found:
            raise SceneError.of(self.found)


class UnknownName(SceneError, KeyError):
    """A name that a plant, a task or a layout does not have; it lists the names there are."""


def join_key(parts: Iterable[str | int]) -> str:
    """Write a dotted key; parts that have their own dots stand in quotes."""
    return ".".join(text if re.fullmatch(r"[\w*-]+", text := str(part)) else f'"{text}"' for part in parts)


def file_keys(section: type[BaseModel], *, root: bool = False) -> list[str]:
    """Keys a section may have in a scene file; the whole file (``root``) may have variants besides."""
    return [name for name, field in section.model_fields.items() if not field.exclude] + ["variants"] * root


def entry_label(entry: object, index: int) -> str:
    """Label of one entry of an array of tables: its name, its cost term, or else its place in the array."""
    if isinstance(entry, dict):
        for key in ("name", "term"):
            if isinstance(entry.get(key), str):
                return entry[key]
    return str(index)


def _is_echo(detail: dict) -> bool:
    """Return whether a list is called too short merely because its entries are wrong, which is reported besides."""
    value = detail["input"]
    long_enough = not isinstance(value, list | tuple) or len(value) >= detail.get("ctx", {}).get("min_length", 0)
    return detail["type"] == "too_short" and long_enough


def _explain(detail: dict, data: object, root: type[BaseModel]) -> dict:
    """The message, key, found and allowed of one of pydantic's errors."""
    kind, loc, value, context = detail["type"], detail["loc"], detail["input"], detail.get("ctx") or {}
    parts, element = _key(loc, data, missing=kind == "missing")
    section, annotation = _schema(loc, root)
    if kind == "value_error" and loc and loc[-1] in section.model_fields and parts[-1:] != [loc[-1]]:
        parts.append(loc[-1])  # what is left out does not fit to the rest
    key = join_key(parts)
    found = None if isinstance(value, dict | BaseModel) else value
    if kind == "extra_forbidden":
        there = described(section)
        allowed = {
            name: there[name].description if name in there else None
            for name in file_keys(section, root=section is root)
        }
        above = [loc[:k] for k in range(len(loc) - 1) if _is_key((*loc[:k], loc[-1]), root)]
        if above:
            owner = join_key(_key(above[-1], data, missing=False)[0]) or "the file"
            return {"message": f"unknown key here, it belongs to {owner}: write it above this table", "key": key}
        return {"message": "unknown key", "key": key, "found": str(loc[-1]), "allowed": allowed}
    if kind == "missing" and isinstance(loc[-1], str):
        return {"message": MISSING, "key": key}
    if kind in ("missing", "too_short", "too_long"):
        return {"message": _length(annotation, context), "key": key, "found": found}
    if kind == "enum":
        choices = re.findall(r"'([^']*)'", context["expected"])
        choices = annotation.names() if isinstance(annotation, type) and issubclass(annotation, Name) else choices
        more = " (your own ones come with --terms FILE.py)" if hasattr(annotation, "registry") else ""
        return {"message": f"no such choice{more}", "key": key, "found": found, "allowed": choices}
    if kind == "value_error":
        return {"message": str(context["error"]), "key": key, "found": found}
    if kind == "tuple_type" and section_in(annotation):
        return {"message": f"must be an array of tables: write [[{key}]]", "key": key, "found": found}
    if kind == "tuple_type":
        return {"message": f"must be {_list(annotation, value)}", "key": key, "found": found}
    plain = {name: int(v) if isinstance(v, float) and v.is_integer() else v for name, v in context.items()}
    message = _WANTED.get(kind, "does not fit here").format(**plain)
    if element is not None:
        message = f"value {element + 1} {message}"
    if found is None:
        message += ", not a table"
    return {"message": message, "key": key, "found": found, "allowed": _ALLOWED.get(kind)}


def _key(loc: tuple, data: object, *, missing: bool) -> tuple[list[str], int | None]:
    """Follow a location through the data: names instead of indices; also which value of a list of numbers it is.

    Parts that are not in the data are pydantic's own markers, except for the last one when a key is missing.
    """
    key: list[str] = []
    for part in loc:
        if isinstance(data, dict) and part in data:
            key.append(part)
            data = data[part]
        elif isinstance(data, list | tuple) and isinstance(part, int) and part < len(data):
            entry = data[part]
            if not isinstance(entry, dict):
                return key, part
            label = entry_label(entry, part)
            if len(data) > 1 or not label.isdigit():
                key.append(label)
            data = entry
    if missing and isinstance(loc[-1], str):
        key.append(loc[-1])
    return key, None


def _schema(loc: tuple, root: type[BaseModel]) -> tuple[type[BaseModel], object]:
    """Follow a location through the types: the section it lies in, and the type of the key it lies at."""
    section, inner, annotation, named = root, root, None, False
    for part in loc:
        if named:
            named = False  # a free name, such as a frame's
        elif isinstance(part, str) and inner is not None:
            section = inner
            if part in section.model_fields:
                annotation = section.model_fields[part].annotation
                inner = section_in(annotation)
                named = inner is not None and get_origin(annotation) is dict
    return section, annotation


def _is_key(loc: tuple, root: type[BaseModel]) -> bool:
    """Return whether a location may end in such a key, which is not a free name."""
    section, annotation = _schema(loc, root)
    return loc[-1] in file_keys(section) and section.model_fields[loc[-1]].annotation is annotation


def section_in(annotation: object) -> type[BaseModel] | None:
    """Section inside a type such as ``tuple[Robot, ...]`` or ``Ground | None``; None where there is none."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for arg in get_args(annotation) if (model := section_in(arg))), None)


def _tuple(annotation: object) -> tuple:
    """The types of a tuple's values inside a type such as ``Vec3 | None``."""
    if get_origin(annotation) is tuple:
        return get_args(annotation)
    return next((types for arg in get_args(annotation) if (types := _tuple(arg))), ())


def _list(annotation: object, value: object) -> str:
    """Kind of list that a type asks for."""
    types = _tuple(annotation)
    if str in types:
        return "a list of names in quotes"
    if Ellipsis not in types:
        return f"a list of {len(types)} numbers"
    return "a list of numbers" if type(value) in (int, float) else "a number or a list of numbers"


def _length(annotation: object, context: dict) -> str:
    types = _tuple(annotation)
    if types and Ellipsis not in types:
        return f"needs exactly {len(types)} values"
    if most := context.get("max_length"):
        return f"has at most {most} values"
    least = context.get("min_length", 1)
    return f"needs at least {least} {'entry' if section_in(annotation) else 'value' if least == 1 else 'values'}"


def _meaning(text: object) -> str:
    """First sentence of what a key means, where that is short."""
    first = re.split(r"(?<!\bal)[.;:](?:\s|$)", " ".join(text.split()))[0] if isinstance(text, str) else ""
    return f" ({first})" if 0 < len(first) <= SHORT else ""


def _shown(value: object) -> str:
    """A value as a scene file would write it; of a long one its ends, for a path's end is the file."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, StrEnum):
        return repr(str(value))
    if isinstance(value, list | tuple):
        text = f"[{', '.join(map(_shown, value))}]"
    else:
        text = repr(value)
    return text if len(text) <= 80 else f"{text[:30]}...{text[-47:]}"


def some(names: Sequence[str], *, most: int = 3) -> str:
    """List the first of many names."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
