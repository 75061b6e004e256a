# SPDX-License-Identifier: Apache-2.0
"""Printing of commands: names and texts from files cannot send control sequences to the terminal."""

from __future__ import annotations

import json
import logging
import sys
from typing import TYPE_CHECKING, Any, TextIO

import typer

from ..physics.runtime.files import plain

if TYPE_CHECKING:
    from rich.console import Console


class Plain(logging.Formatter):
    """Messages of the log where nothing else shows them."""

    def format(self, record: logging.LogRecord) -> str:
        """A record as a text."""
        return plain(super().format(record))


def say(*lines: object, out: TextIO | None = None, end: str = "\n") -> None:
    """Print lines.

    Args:
        lines: What is printed, each as its text.
        out: Where to; standard output if None.
        end: What follows the last of them.
    """
    print(*(plain(str(line)) for line in lines), sep="\n", end=end, file=out or sys.stdout, flush=True)


def headline(text: str, after: str = "") -> None:
    """Print a line that begins in bold on a terminal."""
    typer.echo(typer.style(plain(text), bold=True) + plain(after))


def say_json(data: Any, out: TextIO) -> None:
    """Print data as a line of JSON."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False)
    print("".join(c if plain(c) == c else json.dumps(c)[1:-1] for c in text), file=out, flush=True)


def screen(out: TextIO | None = None, **options: Any) -> Console:
    """A console for tables and bars, whose texts are no markup.

    Args:
        out: Where to; standard output if None.
        options: As for ``rich.console.Console``.
    """
    from rich.console import Console  # slow to import
    from rich.segment import Segment

    class Screen(Console):
        def render(self, *args: Any, **keys: Any):
            for segment in super().render(*args, **keys):
                yield segment if segment.control else Segment(plain(segment.text), segment.style)

    return Screen(file=out, highlight=False, markup=False, **options)
