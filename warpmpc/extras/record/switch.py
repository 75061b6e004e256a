# SPDX-License-Identifier: Apache-2.0
"""Recordings for rerun that are started and stopped while a loop runs."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from ...loop.plant.plant import Plant
    from ...planner.controller.controller import Controller
    from .recorder import RerunRecorder


def rerun_missing() -> str:
    """The cure in one line where rerun is not installed, else nothing."""
    return "" if find_spec("rerun") else 'a recording needs rerun: pip install "warpmpc[record]"'


class RecordingSwitch:
    """Records a loop from :meth:`start` to :meth:`stop`, as often as wanted; in between :meth:`log` costs nothing.

        >>> switch = warpmpc.RecordingSwitch()
        >>> switch.start("push.rrd", mpc, plant)
        >>> switch.log(u)  # in the loop, after plant.apply(u)
        >>> switch.stop()

    All methods are for the thread of the loop.
    """

    def __init__(self) -> None:
        self._recorder: RerunRecorder | None = None

    @property
    def path(self) -> Path | None:
        """File of the recording that is being made, None where none is."""
        return None if self._recorder is None else self._recorder.path

    def start(self, path: str | Path, controller: Controller, plant: Plant) -> None:
        """Begin a recording with the present state; one that is being made is finished before.

        Args:
            path: File to write, ``*.rrd``; an existing file is replaced.

        Raises:
            OSError: If the file cannot be written.
            ValueError: If the file's name does not end in ``.rrd``, or rerun is not installed.
        """
        if missing := rerun_missing():
            raise ValueError(missing)
        from .recorder import RerunRecorder  # slow to import

        self.stop()
        self._recorder = RerunRecorder(path, controller, plant)

    def log(self, control: np.ndarray) -> None:
        """Record one control step if a recording is being made; call it after ``plant.apply(control)``.

        Args:
            control: The control ``[nu]`` that was applied.
        """
        if self._recorder is not None:
            self._recorder.log(control)

    def stop(self) -> Path | None:
        """Finish the recording; returns its file, None where none was being made."""
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return None
        recorder.close()
        return recorder.path
