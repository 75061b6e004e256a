# SPDX-License-Identifier: Apache-2.0
"""Run logs in the formats of others: ``warpmpc export``, and ``--export`` of ``warpmpc run``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .progress import Messages
from .run_folder import logs_in, results_in
from .setup import SUCCESS, results_only, start_warp, user_errors

if TYPE_CHECKING:
    from ..export.data_sets import DataSet
    from ..log.run_log import RunLog
    from ..run.result import EpisodeResult


def export(path: Path, *, mcap: Path | None, hdf5: Path | None, minari: str | None) -> int:
    """Write the episodes of a run log (``.runlog``, ``.npz``) or of a run's folder anew; returns the exit code.

    Args:
        path: The log or folder.
        mcap: File for ROS 2 messages; of several episodes each has its seed in its file's name.
        hdf5: File for a data set of all episodes.
        minari: Id for a data set of all episodes.
    """
    with results_only() as out, Messages(notices=False, warnings=True), user_errors():
        if not any((mcap, hdf5, minari)):
            raise ValueError("say what to write: --mcap FILE.mcap, --hdf5 FILE.hdf5 or --minari NAME-v0")
        from ..export.data_sets import Hdf5DataSet, MinariDataSet
        from ..export.packages import require

        files, results = logs_in(path), results_in(path)
        if mcap is not None:
            require("mcap")
            if mcap.suffix != ".mcap":
                raise ValueError(f"--mcap: must be a .mcap file, not '{mcap}'")
        sets = [*([Hdf5DataSet(hdf5)] if hdf5 else []), *([MinariDataSet(minari)] if minari else [])]
        start_warp()
        from ..export.demonstration import demonstration
        from ..log.run_log import RunLog
        from ..record.replay import require_plans

        seeds, episodes = [], []
        for file in files:  # all are looked at before anything is written
            log = RunLog.load(file)
            seeds.append(log.origin["seed"])
            result = results.get(seeds[-1], {})
            try:
                require_plans(log)
                if not len(log.controls):
                    raise ValueError("the episode has no control: it began at its end")
                if sets:
                    episodes.append(demonstration(log, success=result.get("success"), reason=result.get("reason")))
            except ValueError as error:
                raise ValueError(f"{file}: {error}") from None
        if mcap is not None:
            from ..export.mcap_file import write_mcap

            for file, seed in zip(files, seeds, strict=True):
                one = mcap.with_stem(f"{mcap.stem}-{seed}") if len(files) > 1 else mcap
                write_mcap(RunLog.load(file), one)
                print(one, file=out)
        for made in sets:
            for episode in episodes:
                made.add(episode)
            made.close()
            print(f"{made.name}: {len(files)} episodes, {made.steps} steps", file=out)
    return SUCCESS


class SuccessfulRuns:
    """Data set of the episodes of a run that ended as they should; the others are counted and left out.

    Args:
        name: The data set, as for :func:`~warpmpc.export.data_sets.open_data_set`.
    """

    def __init__(self, name: str):
        self._name = name
        self._data: DataSet | None = None
        self._kept = self._left_out = 0

    def open(self) -> None:
        """Begin the data set.

        Raises:
            ValueError: If it is there already, or a package is missing.
        """
        from ..export.data_sets import open_data_set

        self._data = open_data_set(self._name)

    def add(self, log: RunLog, result: EpisodeResult) -> None:
        """Add an episode, if it ended as it should.

        Raises:
            OSError: If the data set cannot be written.
        """
        if not result.passed or not result.steps:
            self._left_out += 1
            return
        from ..export.demonstration import demonstration

        self._data.add(demonstration(log, success=result.success, reason=result.reason))
        self._kept += 1

    def close(self) -> str:
        """Finish the data set; returns a sentence on what is in it.

        Raises:
            OSError: If it cannot be written.
        """
        self._data.close()
        count = f"{self._kept} of {self._kept + self._left_out} episodes, {self._data.steps} steps"
        more = f"; {self._left_out} that failed or began at the goal are left out" if self._left_out else ""
        return f"{self._data.name}: {'' if self._kept else 'not written, '}{count}{more}"
