# SPDX-License-Identifier: Apache-2.0
"""Progress of a running ``warpmpc`` on stderr: a bar, the engine it chose, and the first warning."""

from __future__ import annotations

import logging
import sys
import time
import warnings
from typing import TYPE_CHECKING

from ..physics.runtime.files import Unwritable
from .terminal import say, screen

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from rich.console import Console

    from ..loop.plant.plant import Plant, PlantBatch
    from ..loop.run.result import EpisodeResult
    from ..planner.controller.controller import Controller

PERIOD, LINES = 0.1, 60.0
"""Time between updates of a bar, which is drawn between plans, never during one; and between lines without one [s]."""

logger = logging.getLogger("warpmpc")


class Messages(logging.Handler):
    """Shows what warpmpc logs: every notice once, and the first warning of an episode; the results count the rest.

    What libraries and users' terms warn of by Python's ``warnings`` is among it.
    """

    def __init__(self, *, notices: bool, warnings: bool):
        super().__init__(logging.INFO)
        self.warnings = warnings
        self.warned = False
        """Whether there was a warning; set it back when an episode starts."""
        self._notices, self._noticed = notices, set()
        self.unwritten = False
        """Whether a file could not be written; such errors are always shown."""

    def __enter__(self) -> Messages:
        self._level_before = logger.level
        logger.setLevel(logging.INFO)
        logger.addHandler(self)
        self._caught = warnings.catch_warnings()
        self._caught.__enter__()
        warnings.showwarning = self._show
        warnings.filterwarnings("ignore", "Attach conflict")  # MuJoCo's, about sizes such as nkey
        return self

    def __exit__(self, *error: object) -> None:
        self._caught.__exit__(*error)
        logger.removeHandler(self)
        logger.setLevel(self._level_before)

    def _show(self, message: Warning | str, category: type[Warning], filename: str, line: int, *rest: object) -> None:
        """Show a warning of Python's, of a library or of a user's term, as one of ours."""
        logger.warning("%s:%d: %s", filename, line, " ".join(str(message).split()))

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record, or not."""
        text = record.getMessage()
        if any(isinstance(part, Unwritable) for part in record.args or ()):
            self.unwritten = True
            if text not in self._noticed:
                say(f"error: {text}", out=sys.stderr)
            self._noticed.add(text)
            return
        if record.levelno < logging.WARNING:
            if self._notices and text not in self._noticed:
                say(text, out=sys.stderr)
            self._noticed.add(text)
            return
        if self.warnings and not self.warned:
            say(f"warning: {text}", out=sys.stderr)
        self.warned = True


class Bar:
    """A bar on stderr if that is a terminal, else a line now and then."""

    def __init__(self, total: float, *, shown: bool):
        self.total, self.shown = total, shown
        self.console: Console | None = None
        self._next = time.perf_counter() + LINES

    def __enter__(self) -> Bar:
        if not self.shown or not sys.stderr.isatty():
            return self
        self._next = 0.0
        from rich.progress import BarColumn, Progress, TextColumn

        self.console = screen(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=10 if self.console.width < 100 else 24),
            TextColumn("{task.fields[numbers]}", markup=False),
            console=self.console,
            auto_refresh=False,
            transient=True,
        )
        self._bar.start()
        self._task = self._bar.add_task("", total=self.total, numbers="building")
        return self

    def __exit__(self, *error: object) -> None:
        if self.console:
            self._bar.stop()

    def due(self) -> bool:
        """Return whether it is time to draw again."""
        return self.shown and time.perf_counter() >= self._next

    def draw(self, description: str, completed: float, numbers: str) -> None:
        """Draw the bar, or print a line if it is time to."""
        if self.console:
            self._bar.update(self._task, description=description, completed=completed, numbers=numbers, refresh=True)
            self._next = time.perf_counter() + PERIOD
        elif self.due():
            say(f"{description}: {numbers}", out=sys.stderr)
            self._next = time.perf_counter() + LINES


class EpisodeBar(Bar):
    """Simulated time of one episode after the other, with the numbers of the last plan.

    Args:
        timeout: Longest simulated time of an episode [s].
    """

    def __init__(self, timeout: float, seeds: Sequence[int], *, shown: bool):
        super().__init__(timeout, shown=shown)
        self._seeds, self._name = seeds, ""

    def start(self, seed: int) -> None:
        """A new episode begins."""
        count = f" ({seed - self._seeds[0] + 1}/{len(self._seeds)})" if len(self._seeds) > 1 else ""
        self._name = f"seed {seed}{count}"
        self.draw(self._name, 0.0, "first plan")
        if self.console:
            self._next = 0.0  # the first step is shown

    def step(self, controller: Controller, plant: Plant, control: np.ndarray) -> None:
        """An episode's ``on_step``."""
        if not (self.due() or plant.done):
            return
        info = controller.info
        goal = "" if plant.error is None else f"goal {plant.error.position:.3f} m  "
        numbers = (
            f"{plant.time:4.1f} s  cost {info.cost:<6.4g} η {info.eta:<4.0f} β {info.beta:<7.2g} "
            f"{goal}plan {info.plan_ms:.0f} ms"
        )
        self.draw(self._name, plant.time, numbers)


class BatchBar(Bar):
    """Finished episodes of a batch."""

    def __init__(self, episodes: int, *, shown: bool):
        super().__init__(episodes, shown=shown)
        self._finished, self._reached, self._has_success = 0, 0, True

    def finish(self, result: EpisodeResult) -> None:
        """An episode is over."""
        self._finished += 1
        self._reached += bool(result.success)
        self._has_success = result.success is not None

    def step(self, controller: Controller, plants: PlantBatch, control: np.ndarray) -> None:
        """A batch's ``on_step``."""
        if self.due():
            self.advance(f"  {plants.time:4.1f} s  plan {controller.info[0].plan_ms:.0f} ms")

    def advance(self, more: str = "") -> None:
        """Draw how many episodes are finished, and more."""
        numbers = f"{self._reached} reached the goal{more}" if self._has_success else more.strip()
        self.draw(f"{self._finished}/{int(self.total)} episodes", self._finished, numbers)
