# SPDX-License-Identifier: Apache-2.0
"""Imports between the rooms of the package and inside them, read from the source.

    python tools/rooms.py

Prints every import between two rooms that goes upwards, every circle of modules inside a room, every room whose lines
exceed its budget in ``tools/rooms.toml``, and the picture of ``docs/architecture.md``. Imports for
type checkers alone count like the others. Exit code 1 where there is such an import, circle or room.
"""

from __future__ import annotations

import argparse
import ast
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).parents[1]
ROOMS = ("cli", "extras", "loop", "planner", "engine", "cost", "scene", "physics", "kernels")
"""Rooms from the top to the bottom; a room imports those below it."""
FLOOR = {room: floor for floor, room in enumerate(reversed(ROOMS))}
PUBLIC = ("__init__", "__main__")
"""Modules above the rooms, which name what is public."""
BUDGETS = Path(__file__).with_name("rooms.toml")


@dataclass(frozen=True)
class Import:
    """An import between two rooms."""

    file: Path
    line: int
    room: str
    target: str
    typing: bool
    """Whether type checkers alone follow it."""
    late: bool
    """Whether it stands in a function."""


def sources() -> Iterator[tuple[Path, tuple[str, ...]]]:
    """Every module of the package: its file and the parts of its name below ``warpmpc``."""
    for folder, lead in ((ROOT / "warpmpc", ()), (ROOT / "kernels", ("kernels",))):
        for file in sorted(folder.rglob("*.py")):
            parts = (*lead, *file.relative_to(folder).with_suffix("").parts)
            if parts[0] not in PUBLIC:
                yield file, parts


def imported(node: ast.stmt, package: tuple[str, ...]) -> Iterator[str]:
    """Rooms that one import statement names."""
    if isinstance(node, ast.Import):
        names = [alias.name.split(".") for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        lead = ["warpmpc", *package[: len(package) - node.level + 1]] if node.level else []
        names = [[*lead, *(node.module or "").split("."), alias.name] for alias in node.names]
    else:
        return
    for name in names:
        parts = [part for part in name if part]
        if parts[0] == "warpmpc" and len(parts) > 1 and parts[1] in FLOOR:
            yield parts[1]


def walk(body: list[ast.stmt], *, typing: bool = False, late: bool = False) -> Iterator[tuple[ast.stmt, bool, bool]]:
    """All statements, with whether they are for type checkers and whether they stand in a function."""
    for node in body:
        yield node, typing, late
        checked = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        inside = late or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for field in ("body", "orelse", "finalbody"):
            rest = getattr(node, field, [])
            yield from walk(rest, typing=typing or (checked and field == "body"), late=inside)
        for handler in getattr(node, "handlers", []):
            yield from walk(handler.body, typing=typing, late=inside)


def imports() -> list[Import]:
    """All imports between rooms."""
    found = set()
    for file, parts in sources():
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node, typing, late in walk(tree.body):
            for target in imported(node, parts[:-1]):
                if target != parts[0]:
                    found.add(Import(file.relative_to(ROOT), node.lineno, parts[0], target, typing, late))
    return sorted(found, key=lambda i: (str(i.file), i.line))


def circles() -> list[list[str]]:
    """Modules of a room that import each other in a circle, each circle sorted."""
    edges: dict[str, set[str]] = {}
    modules = {parts[:-1] if parts[-1] == "__init__" else parts: file for file, parts in sources()}
    for parts, file in modules.items():
        package = parts if file.name == "__init__.py" else parts[:-1]
        targets = edges.setdefault(".".join(parts), set())
        for node, _, _ in walk(ast.parse(file.read_text(encoding="utf-8")).body):
            if not isinstance(node, ast.ImportFrom) or not node.level:
                continue
            lead = (*package[: len(package) - node.level + 1], *filter(None, (node.module or "").split(".")))
            for target in {(*lead, alias.name) for alias in node.names} | {lead}:
                if target in modules and target != parts and target[:1] == parts[:1]:
                    targets.add(".".join(target))
    names = sorted({*edges, *(target for targets in edges.values() for target in targets)})
    graph = np.array([[target in edges.get(name, ()) for target in names] for name in names])
    count, label = connected_components(graph, directed=True, connection="strong")
    groups = [[names[i] for i in np.flatnonzero(label == n)] for n in range(count)]
    return sorted(sorted(group) for group in groups if len(group) > 1)


def lines() -> dict[str, int]:
    """Lines of Python: of each room, and of the folders ``tests`` and ``tools``."""
    found = dict.fromkeys((*ROOMS, "tests", "tools"), 0)
    files = [(parts[0], file) for file, parts in sources()]
    files += [(folder, file) for folder in ("tests", "tools") for file in (ROOT / folder).rglob("*.py")]
    for room, file in files:
        found[room] += len(file.read_text(encoding="utf-8").splitlines())
    return found


def over_budget() -> list[str]:
    """A sentence for each room or folder that has more lines than ``tools/rooms.toml`` allows."""
    budgets = tomllib.loads(BUDGETS.read_text(encoding="utf-8"))["lines"]
    return [f"{room} has {n} lines, {budgets[room]} are its budget" for room, n in lines().items() if n > budgets[room]]


def mermaid(found: list[Import]) -> str:
    """The rooms as a diagram: arrows go from a room to what it imports, but for what a room below imports already."""
    edges = {(i.room, i.target) for i in found if not i.typing}
    below = {room: {b for a, b in edges if a == room} for room in FLOOR}

    def reach(room: str) -> set[str]:
        return below[room] | {far for near in below[room] for far in reach(near)}

    direct = [(a, b) for a, b in edges if not any(b in reach(c) for c in below[a] - {b})]
    direct.sort(key=lambda edge: (ROOMS.index(edge[0]), ROOMS.index(edge[1])))
    targets = {a: " & ".join(b for c, b in direct if c == a) for a, _ in direct}
    return "\n".join(["graph TD", *(f"    {a} --> {b}" for a, b in targets.items())])


def main() -> int:
    """Print what there is to say; returns the exit code."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    found = imports()
    wrong = [i for i in found if FLOOR[i.target] >= FLOOR[i.room]]
    for i in wrong:
        kind = "for type checkers" if i.typing else "in a function" if i.late else "at the top"
        print(f"{i.file}:{i.line}: {i.room} imports {i.target}, which is not below it ({kind})")
    rings = circles()
    for ring in rings:
        print(f"in a circle: {', '.join(ring)}")
    print("\n".join(over := over_budget()))
    print(mermaid([i for i in found if i not in wrong]))
    return int(bool(wrong or rings or over))


if __name__ == "__main__":
    sys.exit(main())
