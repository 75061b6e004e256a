# SPDX-License-Identifier: Apache-2.0
"""Mermaid's ``graph TD`` as a picture, drawn here: its own program would come from the network."""

from __future__ import annotations

import re
from itertools import pairwise

_WIDTH, _HEIGHT, _ACROSS, _DOWN = 96, 28, 132, 62
"""Size of a box, and how far the next one is beside and below it [px]."""
_PAST = 42
"""How far from the middle of a box arrows end that come from further above [px]."""
_BLOCK = re.compile(r"^```mermaid\ngraph TD\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_ARROW = (
    '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
    '<path d="M0,0 L8,4 L0,8 z" fill="currentColor"/></marker></defs>'
)


def drawn(markdown: str) -> str:
    """A page with its graphs drawn."""
    return _BLOCK.sub(lambda found: picture(re.findall(r"(\w+) --> (\w+)", found[1])), markdown)


def picture(edges: list[tuple[str, str]]) -> str:
    """Boxes in rows, each below all that point at it, and the arrows between them, as SVG in a block of HTML."""
    rows = _rows(edges)
    widest = max(map(len, rows))
    place = {
        name: (_ACROSS * (i + 0.5 * (widest - len(row)) + 0.5), _DOWN * depth + _HEIGHT)
        for depth, row in enumerate(rows)
        for i, name in enumerate(row)
    }
    lines = []
    for above, below in edges:
        (x, y), (to_x, to_y) = place[above], place[below]
        if to_y - y > _DOWN:  # past the boxes in between
            to_x += max(-_PAST, min(_PAST, x - to_x))
        ends = f'x1="{x:g}" y1="{y + _HEIGHT / 2:g}" x2="{to_x:g}" y2="{to_y - _HEIGHT / 2:g}"'
        lines.append(f'<line {ends} stroke="currentColor" marker-end="url(#tip)"/>')
    boxes = [
        f'<rect x="{x - _WIDTH / 2:g}" y="{y - _HEIGHT / 2:g}" width="{_WIDTH}" height="{_HEIGHT}" rx="5" '
        f'fill="var(--md-code-bg-color)" stroke="currentColor"/>'
        f'<text x="{x:g}" y="{y + 4:g}" text-anchor="middle" fill="currentColor" font-size="13">{name}</text>'
        for name, (x, y) in place.items()
    ]
    size = f'width="{_ACROSS * widest}" height="{_DOWN * len(rows)}"'
    return f'<div><svg xmlns="http://www.w3.org/2000/svg" {size}>{_ARROW}{"".join(lines + boxes)}</svg></div>'


def _rows(edges: list[tuple[str, str]]) -> list[list[str]]:
    """The names by depth, the length of the longest way to each; beside one another as those above them are."""
    names = list(dict.fromkeys(name for edge in edges for name in edge))
    depth = dict.fromkeys(names, 0)
    for _ in names:
        for above, below in edges:
            depth[below] = max(depth[below], depth[above] + 1)
    rows: list[list[str]] = [[name for name in names if depth[name] == d] for d in range(max(depth.values()) + 1)]
    for before, row in pairwise(rows):
        parents = {name: [before.index(a) for a, b in edges if b == name and a in before] for name in row}
        row.sort(key=lambda name: sum(parents[name]) / max(len(parents[name]), 1))
    return rows
