# SPDX-License-Identifier: Apache-2.0
"""JSON Schema of scene files, with which editors complete and check them while they are written."""

from __future__ import annotations

from types import NoneType
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, models_json_schema

from .describe import keys
from .schema import Cost, Scene
from .types import ONE_FOR_LIST

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import core_schema

    from .types import Section

DRAFT = "http://json-schema.org/draft-07/schema#"
"""The draft that TOML editors know."""


class _FileSchema(GenerateJsonSchema):
    """Schema of a file where it is more than pydantic's types tell."""

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
