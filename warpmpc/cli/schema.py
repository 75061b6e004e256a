# SPDX-License-Identifier: Apache-2.0
"""``warpmpc schema``: the JSON Schema of scene files, built-in cost terms included."""

from __future__ import annotations

import json

from ..cost.builtin import BUILTIN
from ..scene.json_schema import scene_json_schema


def schema_text() -> str:
    """The schema as JSON."""
    terms = {name: (term.keys, term.summary) for name, term in BUILTIN.items()}
    return json.dumps(scene_json_schema(terms), indent=2, ensure_ascii=False) + "\n"
