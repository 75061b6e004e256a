# SPDX-License-Identifier: Apache-2.0
"""A table's runs summed up: what is printed, and the Markdown and JSON that go into the documentation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from rich.table import Table as Grid

from .metrics import METRICS, Estimate, estimate, paper_shown, shown
from .runs import Run
from .tables import Cell, Table


@dataclass(frozen=True)
class Row:
    """One cell with the runs made of it."""

    cell: Cell
    runs: list[tuple[Run, dict]]
    """Runs with their records, by seed."""

    @property
    def records(self) -> list[dict]:
        """The records alone."""
        return [record for _, record in self.runs]

    def estimates(self, metrics: Sequence[str]) -> dict[str, Estimate | None]:
        """Metric → estimate."""
        return {name: estimate(METRICS[name], self.records) for name in metrics}

    def failures(self, metrics: Sequence[str]) -> dict[str, list[Run]]:
        """What went wrong → the runs in which it did; collisions count where the table watches them."""
        found: dict[str, list[Run]] = {}
        for run, record in self.runs:
            if not record["result"]["success"]:
                found.setdefault(record["result"]["reason"], []).append(run)
            if "free" in metrics and not METRICS["free"].of(record):
                found.setdefault("collision", []).append(run)
        return found


@dataclass(frozen=True)
class Report:
    """A table with its runs.

    Args:
        name: Name of the table.
        table: The table.
        rows: Its cells.
        command: The command that made it.
        machine: Hardware and versions of the machine that wrote it.
        date: When it was written.
        code: Digest of the code as it is now.
    """

    name: str
    table: Table
    rows: list[Row]
    command: str
    machine: dict
    date: str
    code: str

    def markdown(self) -> str:
        """The table, its failures and its circumstances, to be included in a page."""
        metrics = self.table.metrics
        titles = [METRICS[name].heading for name in metrics]
        lines = [
            f"## {self.table.title}",
            "",
            _line(["", "runs", *titles]),
            _line(["---", *["---:"] * (len(titles) + 1)]),
        ]
        for row in self.rows:
            lines.append(_line([row.cell.title, str(len(row.runs)), *self._figures(row)]))
            if row.cell.paper:
                figures = row.cell.paper
                paper = [paper_shown(METRICS[name], figures[name]) if name in figures else "" for name in metrics]
                lines.append(_line(["*paper*", "", *(f"*{text}*" if text else "" for text in paper)]))
        lines += ["", *self._failures(), *self._circumstances()]
        return "\n".join(lines) + "\n"

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Columns and rows as ``docs/data`` has them: rates as counts, other figures as in :meth:`markdown`."""
        metrics = [METRICS[name] for name in self.table.metrics]
        rows = []
        for row in self.rows:
            cells = [row.cell.title]
            for metric, found in zip(metrics, row.estimates(self.table.metrics).values(), strict=True):
                counted = found is not None and metric.rate
                cells.append(f"{found.value * found.count:.0f} of {found.count}" if counted else shown(metric, found))
            rows.append(cells)
        return ["", *(metric.heading for metric in metrics)], rows

    def _figures(self, row: Row) -> list[str]:
        return [shown(METRICS[name], found) for name, found in row.estimates(self.table.metrics).items()]

    def _failures(self) -> list[str]:
        lines = []
        for row in self.rows:
            for what, runs in row.failures(self.table.metrics).items():
                seeds = _seeds(runs, with_scene=len(row.cell.scenes) > 1)
                lines.append(f"- {row.cell.title}, {len(runs)} × {what}: {seeds}. One alone: `{runs[0].command}`")
        return ["Failures:", "", *lines, ""] if lines else ["No failures.", ""]

    def _circumstances(self) -> list[str]:
        records = [record for row in self.rows for record in row.records]
        notes = [
            "± and brackets: 95 % interval of the mean (Student's t) or of the rate (Wilson). The paper's ± is a "
            "standard deviation. Times and lengths are those of runs that reached the goal."
        ]
        if self.table.note:
            notes.append(self.table.note)
        if at_once := sorted({record["jobs"] for record in records if record["jobs"] > 1}):
            notes.append(
                f"Runs were made {', '.join(map(str, at_once))} at a time with one thread each: plan times are not "
                "those of a run on its own."
            )
        if older := sum(record["code"] != self.code for record in records):
            notes.append(f"{older} of these {len(records)} runs were made by another state of the code.")
        where = "; ".join(sorted({_hardware(record) for record in records}))
        versions = ", ".join(f"{key} {value}" for key, value in self.machine.items() if key not in ("cpu", "cores"))
        made = f"`{self.command}` · {self.date} · {where or 'no runs yet'} · {versions}"
        return ["\n\n".join([*notes, made])]

    def to_json(self) -> dict:
        """All figures as data."""
        metrics = self.table.metrics
        cells = []
        for row in self.rows:
            estimates = {name: asdict(found) if found else None for name, found in row.estimates(metrics).items()}
            failures = {
                what: [{"scene": run.job.scene, "seed": run.job.seed, "command": run.command} for run in runs]
                for what, runs in row.failures(metrics).items()
            }
            cells.append(
                {
                    "name": row.cell.name,
                    "title": row.cell.title,
                    "scenes": row.cell.scenes,
                    "runs": len(row.runs),
                    "paper": row.cell.paper,
                    "ours": estimates,
                    "failures": failures,
                }
            )
        return {
            "table": self.name,
            "title": self.table.title,
            "command": self.command,
            "date": self.date,
            "machine": self.machine,
            "cells": cells,
        }

    def grid(self) -> Grid:
        """The table for a terminal."""
        out = Grid(title=self.table.title)
        out.add_column("cell")
        for title in ("runs", *(METRICS[name].title for name in self.table.metrics)):
            out.add_column(title, justify="right")
        for row in self.rows:
            texts = []
            for name, ours in zip(self.table.metrics, self._figures(row), strict=True):
                figure = row.cell.paper.get(name)
                texts.append(ours + (f"\npaper {paper_shown(METRICS[name], figure)}" if figure else ""))
            out.add_row(row.cell.name, str(len(row.runs)), *texts)
        return out

    def failure_lines(self) -> list[str]:
        """The failures for a terminal, one a line."""
        return [
            f"{row.cell.name}: {len(runs)} × {what}: {_seeds(runs, with_scene=len(row.cell.scenes) > 1)}: "
            f"{runs[0].command}"
            for row in self.rows
            for what, runs in row.failures(self.table.metrics).items()
        ]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _seeds(runs: Sequence[Run], *, with_scene: bool) -> str:
    """``seeds 3, 7``, by scene where a cell has several."""
    by_scene: dict[str, list[str]] = {}
    for run in runs:
        by_scene.setdefault(run.job.scene, []).append(str(run.job.seed))
    parts = []
    for scene, seeds in by_scene.items():
        word = "seed" if len(seeds) == 1 else "seeds"
        parts.append(f"{word} {', '.join(seeds)}" + (f" of {scene}" if with_scene else ""))
    return "; ".join(parts)


def _hardware(record: dict) -> str:
    text = f"{record['cores']} cores of {record['cpu']}"
    return f"{text}, {record['gpu']}" if record["gpu"] else text
