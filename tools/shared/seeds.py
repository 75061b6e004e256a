# SPDX-License-Identifier: Apache-2.0
"""Rule of seeds: tuning has seeds 0 to 999, a report draws a block above them that nobody has looked at."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

FILE = Path(__file__).parents[1] / "seeds.toml"
TUNING = range(1000)
COUNT = 10
"""Seeds of a report."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """Seeds that one report has used."""

    report: str
    first: int
    last: int
    settings: str = ""
    """Digest of what the report was made with."""

    @property
    def seeds(self) -> range:
        """The seeds themselves."""
        return range(self.first, self.last + 1)


def blocks(file: Path = FILE) -> list[Block]:
    """All blocks, in the order they were drawn.

    Raises:
        ValueError: If the file is not as this module writes it.
    """
    try:
        return [Block(**block) for block in tomllib.loads(file.read_text(encoding="utf-8"))["block"]]
    except (KeyError, TypeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{file}: no list of blocks, each with report, first and last: {error}") from None


def draw(report: str, settings: str, file: Path = FILE) -> range:
    """Seeds of a report: the next unused block, written to the file; or its own, when it goes on.

    Args:
        report: Name of the report.
        settings: Digest of what it is made with.
        file: File of the blocks.

    Raises:
        ValueError: If a report of that name was made with other settings, or the name cannot be written.
    """
    if not report.isprintable() or not report.strip() or set(report) & {'"', "\\"}:
        raise ValueError(f"--report {report!r}: a name is printable, without quotes or backslashes")
    drawn = blocks(file)
    for block in drawn:
        if block.report == report and block.settings == settings:
            return block.seeds
        if block.report == report:
            raise ValueError(
                f"{file}: report '{report}' was made with other settings, its seeds are worn out: take another name"
            )
    first = 1 + max(TUNING[-1], *(block.last for block in drawn))
    own = Block(report=report, first=first, last=first + COUNT - 1, settings=settings)
    with file.open("a", encoding="utf-8") as out:
        out.write(f'\n[[block]]\nreport = "{own.report}"\nfirst = {own.first}\nlast = {own.last}\n')
        out.write(f'settings = "{own.settings}"\n')
    return own.seeds


def worn(seeds: Iterable[int]) -> list[int]:
    """Those of some seeds that no report can draw once somebody has looked at them, in order."""
    return sorted({seed for seed in seeds if seed not in TUNING})
