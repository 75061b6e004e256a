# SPDX-License-Identifier: Apache-2.0
"""Files of results."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any


def write_json(path: Path, data: object) -> None:
    """Write data as JSON; the file is never there in part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f"{path.name}.new")
    new.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    os.replace(new, path)


def put_rows(
    path: Path,
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    study: str,
    arguments: Sequence[str],
    **more: str,
) -> None:
    """Put the rows of a study's command, run now and here, into a table's file.

    Args:
        path: File of the table.
        columns: Heads of the columns.
        rows: The rows.
        study: Name of the study.
        arguments: Of its command line; where files go is left out.
        more: ``note``, and ``machine`` where this is not the machine.
    """
    from .machine import machine

    here, words = machine(), list(arguments)
    for option in ("--json", "--waits", "--out"):
        if option in words:
            del words[(at := words.index(option)) : at + 2]
    command = shlex.join(["python", "tools/study.py", study, *words])
    where = {"machine": f"{here['cores']} cores of {here['cpu']}", "date": f"{date.today()}", "command": command}
    put_group(path, columns, {**where, **more, "rows": rows})


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
