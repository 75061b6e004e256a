# SPDX-License-Identifier: Apache-2.0
"""A progress bar on stderr for tools that run for hours."""

from __future__ import annotations

from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text


class _TimeLeft(ProgressColumn):
    """Time left at the pace so far; parallel work ends in bursts, which the pace of late would mistake for speed."""

    def render(self, task: Task) -> Text:
        if not task.completed or not task.elapsed or task.total is None:
            return Text("-:--:-- left", style="progress.remaining")
        seconds = task.elapsed / task.completed * (task.total - task.completed)
        return Text(f"{timedelta(seconds=round(seconds))} left", style="progress.remaining")


class Bar:
    """How many of a number of things are done, for how long that took and how long the rest will take.

    Args:
        total: Number of things to do.
    """

    def __init__(self, total: int):
        columns = (
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            _TimeLeft(),
        )
        self._progress = Progress(*columns, console=Console(stderr=True))
        self._task = self._progress.add_task("", total=total)

    def __enter__(self) -> Bar:
        self._progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.stop()

    def step(self, what: str) -> None:
        """One more thing is done."""
        self._progress.update(self._task, advance=1, description=what)

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        self._progress.console.print(line, markup=False, highlight=False, soft_wrap=True)
