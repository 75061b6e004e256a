# SPDX-License-Identifier: Apache-2.0
"""``warpmpc schema``: the JSON Schema of scene files, built-in cost terms included."""

from __future__ import annotations

import json

from ..scene.json_schema import scene_json_schema
from ..terms import TERMS


def schema_text() -> str:
    """The schema as JSON."""
    terms = {name: (term.keys, term.summary) for name, term in TERMS.items()}
    return json.dumps(scene_json_schema(terms), indent=2, ensure_ascii=False) + "\n"
