#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write the tables of README and the documentation's pages from the figures in docs/data.

    python tools/pages/figures.py              # rewrites README.md and docs/*.md where figures changed
    python tools/pages/figures.py --check      # writes nothing; exit code 1 when a page is not what it would be

A table stands between ``<!-- data: NAME -->`` and ``<!-- end -->``; ``docs/data/NAME.json`` has its columns
and groups of rows that were measured together, each with its machine, date and command. ``<!-- data: NAME readme -->``
takes the rows that a group names under ``readme`` and leaves out where they are from. The episodes of
``control_suite.json`` are those of ``tools/study.py dm_suite --json``. Exit code 2 for bad figures.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import NotRequired, TypedDict

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data"
EPISODES = "control_suite"
"""Figures that are episodes, from which a table is computed."""

_TABLE = re.compile(r"(<!-- data: (\w+)( readme)? -->\n).*?(<!-- end -->)", re.DOTALL)


class Group(TypedDict):
    """Rows that were measured together."""

    rows: list[list[str]]
    machine: NotRequired[str]
    date: NotRequired[str]
    command: NotRequired[str]
    note: NotRequired[str]
    readme: NotRequired[list[int]]


class Figures(TypedDict):
    """One file of figures."""

    columns: list[str]
    groups: list[Group]


def pages() -> list[Path]:
    """README and every page of the documentation."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def read(name: str) -> Figures:
    """Figures of a file in docs/data.

    Raises:
        ValueError: If there is no such file, or a row has not as many cells as there are columns.
    """
    path = DATA / f"{name}.json"
    try:
        found: Figures = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    for row in (row for group in found["groups"] for row in group["rows"]):
        if len(row) != len(found["columns"]):
            raise ValueError(f"{path}: {len(found['columns'])} columns, but a row of {len(row)} cells: {row}")
    return found


def table(figures: Figures, *, readme: bool = False) -> str:
    """Markdown of figures: the rows, and below them where they are from.

    Args:
        figures: Columns and groups of rows.
        readme: Take the rows that groups name for README, without where they are from.
    """
    lines = [_row(figures["columns"]), "|" + "---|" * len(figures["columns"])]
    for group in figures["groups"]:
        rows = group["rows"]
        lines += [_row(row) for row in ([rows[i] for i in group.get("readme", [])] if readme else rows)]
    if not readme:
        lines += ["", *_sources(figures["groups"])]
    return "\n".join(lines) + "\n"


def rewritten(text: str) -> str:
    """A page's text with every table as its figures are.

    Raises:
        ValueError: As :func:`read`.
    """

    def fill(found: re.Match[str]) -> str:
        begin, name, readme, end = found.groups()
        body = _suite() if name == EPISODES else table(read(name), readme=bool(readme))
        return f"{begin}{body}{end}"

    return _TABLE.sub(fill, text)


def _row(cells: list[str]) -> str:
    return f"|{'|'.join(cells)}|"


def _sources(groups: list[Group]) -> list[str]:
    """Where rows are from: a line for each group, with the rows' numbers where there are several."""
    lines, first = [], 1
    for group in groups:
        text = ", ".join(part for part in (group.get("machine", ""), group.get("date", "")) if part)
        text += f": `{group['command']}`" if "command" in group else ""
        text += f" ({group['note']})" if "note" in group else ""
        last = first + len(group["rows"]) - 1
        rows = f"* Row {first}: " if last == first else f"* Rows {first} to {last}: "
        lines.append(f"{rows if len(groups) > 1 else ''}{text[:1].upper()}{text[1:]}.")
        first = last + 1
    return lines


def _suite() -> str:
    """The Control Suite's table, computed from its episodes."""
    sys.path.insert(0, str(ROOT / "tools"))
    from dm_tasks.table import read as episodes
    from dm_tasks.table import table as suite

    return re.sub(r" ?\| ?", "|", suite(episodes([DATA / f"{EPISODES}.json"]))) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Command line of this tool; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, tell which pages would change")
    args = parser.parse_args(arguments)
    try:
        new = {page: rewritten(page.read_text(encoding="utf-8")) for page in pages()}
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    changed = [page for page, text in new.items() if text != page.read_text(encoding="utf-8")]
    for page in changed:
        print(f"{page.relative_to(ROOT)}: {'is not what its figures say' if args.check else 'written'}")
        if not args.check:
            page.write_text(new[page], encoding="utf-8")
    return int(args.check and bool(changed))


if __name__ == "__main__":
    sys.exit(main())
