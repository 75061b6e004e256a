# SPDX-License-Identifier: Apache-2.0
"""Code blocks of Markdown pages: files that they name, programs, commands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[2]


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of every code block of a page, named from the checkout's root."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"^```(\w+)\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


def files(page: str) -> dict[str, str]:
    """Blocks whose first line is a comment with a file name, by that name."""
    named = {}
    for _, text in blocks(page):
        if found := re.match(r"(?:<!--|#)\s*([\w.]+\.(?:urdf|xml|py|toml))\b", text):
            named[found.group(1)] = text
    return named


def write_files(page: str, folder: Path) -> None:
    """Write the files that a page names into a folder."""
    for name, text in files(page).items():
        (folder / name).write_text(text, encoding="utf-8")


def commands(page: str) -> list[list[str]]:
    """Arguments of every ``warpmpc`` command that a page shows."""
    text = "\n".join(text for kind, text in blocks(page) if kind == "sh").replace("\\\n", " ")
    parts = (part.partition(" > ")[0] for line in text.splitlines() for part in line.split("&&"))
    shown = [shlex.split(part, comments=True) for part in parts if "warpmpc" in part]
    return [words[1:] for words in shown if words and words[0].endswith("warpmpc")]
