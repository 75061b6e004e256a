# SPDX-License-Identifier: Apache-2.0
"""Files of results."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def write_json(path: Path, data: object) -> None:
    """Write data as JSON; the file is never there in part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f"{path.name}.new")
    new.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    os.replace(new, path)


def put_group(path: Path, columns: Sequence[str], group: Mapping[str, Any]) -> None:
    """Put a command's rows into a table's file, as ``docs/data`` has them, in place of those it made before.

    Args:
        path: File of the table.
        columns: Heads of the columns.
        group: ``command``, ``date``, ``machine`` and ``rows``; without rows those made before are taken away.
    """
    groups = json.loads(path.read_text(encoding="utf-8"))["groups"] if path.exists() else []
    groups = [old for old in groups if old["command"] != group["command"]]
    write_json(path, {"columns": columns, "groups": [*groups, *([group] if group["rows"] else [])]})
