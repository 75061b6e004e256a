# SPDX-License-Identifier: Apache-2.0
"""The keys of scene files in words: what a key takes, in which unit, and what holds when it is left out.

JSON Schema of scene files, with which editors complete and check them while they are written.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema, models_json_schema
from pydantic_core import PydanticUndefined

from .schema import Cost, Scene
from .types import ONE_FOR_LIST, described

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import core_schema

    from .types import Section

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
    return {name: field for name, field in described(section).items() if not field.exclude}


DRAFT = "http://json-schema.org/draft-07/schema#"
"""The draft that TOML editors know."""


class _FileSchema(GenerateJsonSchema):
    """Schema of a file where it is more than pydantic's types tell."""

    def model_schema(self, schema: core_schema.ModelSchema) -> JsonSchemaValue:
        """Sections whose keys are described."""
        out = super().model_schema(schema)
        for name, field in described(schema["cls"]).items():
            if field.description and name in out.get("properties", {}):
                out["properties"][name] |= {"description": field.description}
        return out

    def function_before_schema(self, schema: core_schema.BeforeValidatorFunctionSchema) -> JsonSchemaValue:
        """One entry may stand where a list is meant."""
        inner = self.generate_inner(schema["schema"])
        if schema["function"]["function"] in ONE_FOR_LIST:
            return {"anyOf": [inner["items"], inner]}
        return inner

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        """TOML has no null: what may be absent is switched off with false."""
        inner = self.generate_inner(schema["schema"])
        return inner if inner.get("type") == "boolean" else {"anyOf": [inner, {"const": False}]}

    def tuple_schema(self, schema: core_schema.TupleSchema) -> JsonSchemaValue:
        """Lists of fixed length as draft 7 writes them."""
        out = super().tuple_schema(schema)
        if "prefixItems" in out:
            out["items"] = out.pop("prefixItems")
            out["additionalItems"] = False
        return out

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        """Default of a key, where that is a value; the defaults of sections stand at their keys."""
        out = super().default_schema(schema)
        if isinstance(out.get("default"), dict | NoneType) or out.get("default") == []:
            out.pop("default", None)
        return out

    def field_title_should_be_set(self, schema: object) -> bool:
        """Keys need no titles beside their names."""
        return False


def scene_json_schema(terms: Mapping[str, tuple[type[Section], str]]) -> dict[str, Any]:
    """JSON Schema (draft 7) of scene files.

    Args:
        terms: Keys of the built-in cost terms by the term's name, and what each term is in one sentence. Tables of
            other terms may have any keys.
    """
    models: list[type[BaseModel]] = [Scene, *dict.fromkeys(section for section, _ in terms.values())]
    places, whole = models_json_schema([(model, "validation") for model in models], schema_generator=_FileSchema)
    parts = whole["$defs"]
    name_of = {model: places[model, "validation"]["$ref"].rsplit("/", 1)[-1] for model in models}
    scene = parts.pop(name_of[Scene])
    scene["properties"] = {key: scene["properties"][key] for key in keys(Scene)}
    scene["properties"]["variants"] = {
        "description": "Named changes of the scene: `SCENE:VARIANT` has one of them laid over it, `SCENE:A+B` two.",
        "type": "object",
        "additionalProperties": {"type": "object"},
    }
    own = parts[Cost.__name__]
    choices = [_term(own, name, text, parts[name_of[section]]) for name, (section, text) in terms.items()]
    user = {**own, "title": "your own term", "additionalProperties": True}
    user["properties"] = {**own["properties"], "term": {"type": "string", "not": {"enum": list(terms)}}}
    parts[Cost.__name__] = {"description": own["description"], "oneOf": [*choices, user]}
    for section in name_of.keys() - {Scene}:
        del parts[name_of[section]]
    return _plain({"$schema": DRAFT, "title": "warpmpc scene", **scene, "$defs": parts})


def _term(own: dict, name: str, text: str, section: dict) -> dict:
    """The table of one built-in term, told from others by its key ``term``."""
    about = {"const": name, "type": "string", "description": text}
    return {
        "title": name,
        "description": text,
        "type": "object",
        "properties": {**own["properties"], "term": about, **section["properties"]},
        "required": ["term", *section.get("required", [])],
        "additionalProperties": False,
    }


def _plain(node: Any) -> Any:
    """The schema with its texts as plain ones: double backticks are for docstrings."""
    if isinstance(node, dict):
        return {key: _plain(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_plain(item) for item in node]
    return node.replace("``", "`") if isinstance(node, str) else node
