#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write the tables of README and the documentation's pages from the figures in docs/data.

    python tools/pages/figures.py              # rewrites README.md and docs/*.md where figures changed
    python tools/pages/figures.py --check      # writes nothing; exit code 1 when a page is not what it would be

A table stands between ``<!-- data: NAME -->`` and ``<!-- end -->``; ``docs/data/NAME.json`` has its columns
and groups of rows that were measured together, each with its machine, date and command. ``<!-- data: NAME readme -->``
takes the rows that a group names under ``readme`` and leaves out where they are from. ``{NAME|CELL & CELL|COLUMN}`` in
a cell is the figure of another file, in the row that has these cells. Episodes of ``control_suite.json`` are those of
``tools/study.py dm_suite --json``; ``{control_suite}`` is what the line below that table says first. Pages of
tools/pages/figures.toml are written as a whole: titles, sentences, tables, pictures. Exit code 2 for bad figures.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NotRequired, TypedDict

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data"
WHOLE = Path(__file__).with_name("figures.toml")
"""Pages that are written as a whole."""
EPISODES = "control_suite"
"""Figures that are episodes, from which a table is computed."""

_TABLE = re.compile(r"(<!-- data: (\w+)( readme)? -->\n).*?(<!-- end -->)", re.DOTALL)
_REFERENCE = re.compile(r"\{(\w+)\|([^|}]+)\|([^|}]+)\}")


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
        lines += [f"\n{source}" if i == 0 else source for i, source in enumerate(_sources(figures["groups"]))]
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


def assembled(page: Mapping[str, Any]) -> str:
    """Text of a page of tables, pictures and sentences, its tables empty.

    Args:
        page: ``title``, ``text`` and a list of ``section``, each with ``title``, ``text``, ``data`` and ``picture``
            (file name and words), all but the title if there is any.
    """
    parts = [f"# {page['title']}", page["text"]]
    for section in page["section"]:
        parts += [f"## {section['title']}", section.get("text", "")]
        parts += [f"<!-- data: {name} -->\n<!-- end -->" for name in section.get("data", [])]
        parts += [f"![{words}]({file})" for file, words in section.get("picture", {}).items()]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _row(cells: list[str]) -> str:
    return f"|{'|'.join(map(_resolved, cells))}|"


def _resolved(cell: str) -> str:
    """A cell with the figures of other files that it refers to."""
    if "{control_suite}" in cell:
        cell = cell.replace("{control_suite}", _suite().split("\n\n")[-1].partition(". ")[0])
    return _REFERENCE.sub(lambda found: _figure(*found.groups()), cell)


def _figure(name: str, row: str, column: str) -> str:
    figures, cells = read(name), set(row.replace("`", "").split(" & "))
    rows = [r for group in figures["groups"] for r in group["rows"] if cells <= {cell.replace("`", "") for cell in r}]
    if len(rows) != 1 or column not in figures["columns"]:
        raise ValueError(f"{DATA / name}.json: {len(rows)} rows have {row}, columns are {figures['columns']}")
    return rows[0][figures["columns"].index(column)]


def _sources(groups: list[Group]) -> list[str]:
    """Where rows are from: a line for each group, with the rows' numbers where there are several."""
    lines, first = [], 1
    for group in groups:
        text = ", ".join(part for part in (group.get("machine", ""), group.get("date", "")) if part)
        text += f": `{group['command']}`" if "command" in group else ""
        text += f" ({group['note']})" if "note" in group else ""
        last = first + len(group["rows"]) - 1
        rows = f"* Row {first}: " if last == first else f"* Rows {first} to {last}: "
        if text:
            lines.append(f"{rows if len(groups) > 1 else ''}{text[:1].upper()}{text[1:]}.")
        first = last + 1
    return lines


def _suite() -> str:
    """The Control Suite's table, computed from its episodes."""
    sys.path.insert(0, str(ROOT / "tools"))
    from studies.suite.table import read as episodes
    from studies.suite.table import table as suite

    return re.sub(r" ?\| ?", "|", suite(episodes([DATA / f"{EPISODES}.json"]))) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Command line of this tool; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, tell which pages would change")
    args = parser.parse_args(arguments)
    try:
        texts = {page: page.read_text(encoding="utf-8") for page in pages()}
        listed = tomllib.loads(WHOLE.read_text(encoding="utf-8"))
        texts |= {ROOT / page["file"]: assembled(page) for page in listed["page"]}
        new = {page: rewritten(text) for page, text in texts.items()}
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    changed = [page for page, text in new.items() if not page.exists() or text != page.read_text(encoding="utf-8")]
    for page in changed:
        print(f"{page.relative_to(ROOT)}: {'is not what its figures say' if args.check else 'written'}")
        if not args.check:
            page.write_text(new[page], encoding="utf-8")
    return int(args.check and bool(changed))


if __name__ == "__main__":
    sys.exit(main())
