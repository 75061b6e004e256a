# SPDX-License-Identifier: Apache-2.0
"""Files that ``warpmpc run`` writes of its episodes: run logs, also as CSV and NPZ, and recordings for rerun.

Run logs in the formats of others: ``warpmpc export``, and ``--export`` of ``warpmpc run``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..loop.log.run_log import SUFFIX, log_file
from ..loop.run.run_recorder import RunRecorder
from ..physics.runtime.files import try_file
from .progress import Messages
from .run_folder import LOG, RECORDING, RunFolder, check_folder, logs_in, results_in
from .setup import SUCCESS, extra, others_whole, results_only, start_warp, user_errors
from .terminal import say

if TYPE_CHECKING:
    import numpy as np

    from ..extras.export.data_sets import Hdf5DataSet
    from ..loop.log.run_log import RunLog
    from ..loop.run.episode import Episode, Recorder
    from ..loop.run.result import EpisodeResult
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """The files asked for; of several episodes, each has its seed in its files' names."""

    record: Path | None = None
    csv: Path | None = None
    npz: Path | None = None
    out: Path | None = None
    """Folder of the run, which has a log and, with rerun, a recording of every episode."""
    export: SuccessfulRuns | None = None
    """Data set of the episodes that ended as they should."""
    several: bool = False
    """True if there are several episodes."""

    @property
    def logs(self) -> bool:
        """Return whether run logs are to be written."""
        return any((self.csv, self.npz, self.out, self.export))

    @property
    def any(self) -> bool:
        """Return whether anything is to be written."""
        return self.logs or self.record is not None

    def check(self, seeds: Sequence[int], *, envs: int, jobs: str | None) -> None:
        """Refuse files that cannot be made.

        Raises:
            ValueError: If options do not go together.
            OSError: If a file cannot be written.
        """
        for name in ("record", "csv", "npz", "out"):
            path = getattr(self, name)
            if path is None:
                continue
            if envs > 1:
                raise ValueError(f"--{name}: a file shows one environment: leave out --envs or --{name}")
            if name == "record" and (missing := rerun_missing()):
                raise ValueError(f"--record: {missing}")
            if name == "record" and jobs is not None:
                raise ValueError("--record: a recording is made here: leave out --jobs, or take --csv or --npz")
            if name == "out":
                check_folder(path)
                if missing := rerun_missing():
                    logger.info("--out: the folder gets no recording: %s", missing)
                continue
            if name != "record" and log_file(path).suffix != f".{name}":
                raise ValueError(f"--{name}: must be a .{name} file, not '{path}'")
            if not path.absolute().parent.is_dir():
                raise ValueError(f"--{name}: no such folder: {path.absolute().parent}")
            files = [self._path(path, seed) for seed in seeds]
            for file in [files[0], files[-1], *filter(Path.exists, files[1:-1])]:
                try_file(file)
        if self.export is not None:
            if envs > 1:
                raise ValueError("--export: logs are of one environment: leave out --envs, --jobs is quicker")
            self.export.open()

    def recordings(self, seed: int) -> list[Path]:
        """Files for rerun of an episode; none in a folder where rerun is not installed."""
        folder = None if self.out is None or rerun_missing() else self.out / RECORDING
        return [self._path(path, seed) for path in (self.record, folder) if path is not None]

    def folder(
        self, scene: Scene, *, seeds: Sequence[int], term_files: Sequence[Path], asked: dict[str, Any]
    ) -> RunFolder | None:
        """The run's folder, begun, as :class:`RunFolder` has it; None where none is asked for.

        Raises:
            OSError: If it cannot be written.
        """
        if self.out is None:
            return None
        return RunFolder(self.out, scene, seeds=seeds, term_files=term_files, asked=asked)

    def recorders(self, episode: Episode) -> Recorders:
        """Recorders of an episode's steps."""
        path = self.log(episode.seed)
        log = RunRecorder(episode.plant, episode.controller, path=path) if self.logs else None
        made: list[Recorder] = [log] if log else []
        for path in self.recordings(episode.seed):
            from ..extras.record.recorder import RerunRecorder as Recording  # slow to import

            with others_whole():
                made.append(Recording(path, episode.controller, episode.plant))
        return Recorders(made, log)

    def log(self, seed: int) -> Path | None:
        """File that the log of an episode is written to while it runs; None without a folder."""
        return None if self.out is None else self._path(self.out / LOG, seed)

    def beside(self, seed: int) -> Path | None:
        """File for the log of a run in real time while it runs, beside the first file that is made of it."""
        path = next(filter(None, (self.npz, self.csv, self.record)), None)
        return None if path is None else self._path(path, seed).with_name(f"{self._path(path, seed).name}{SUFFIX}")

    def save(self, log: RunLog, seed: int, result: EpisodeResult | None = None) -> None:
        """Write the log of an episode to the files that are not there yet, and to the data set with its result."""
        folder = self.log(seed)
        for path in (self.csv, self.npz):
            if path is not None:
                with others_whole():
                    log.save(self._path(path, seed))
        if folder is not None and not folder.exists():
            with others_whole():
                log.save(folder)
        if self.export is not None:
            with others_whole():
                self.export.add(log, result)

    def _path(self, path: Path, seed: int) -> Path:
        return path.with_stem(f"{path.stem}-{seed}") if self.several else path


class Recorders:
    """Several recorders of one episode.

    Args:
        recorders: The recorders.
        log: The one of them that keeps a run log, if any.
    """

    def __init__(self, recorders: Sequence[Recorder], log: RunRecorder | None):
        self._recorders, self._log = recorders, log

    def log(self, control: np.ndarray) -> None:
        """Hand the step just made to all."""
        for recorder in self._recorders:
            recorder.log(control)

    def close(self) -> None:
        """Close all."""
        for recorder in self._recorders:
            recorder.close()

    @property
    def run_log(self) -> RunLog | None:
        """The log so far, if one is kept."""
        return self._log.run_log if self._log else None


def rerun_missing() -> str:
    """The cure in one line where nothing can be recorded for rerun, else nothing."""
    record = extra("record.switch")
    return record.rerun_missing() if record else "warpmpc is installed without its extras"


def export(path: Path, *, mcap: Path | None, hdf5: Path | None) -> int:
    """Write the episodes of a run log (``.runlog``, ``.npz``) or of a run's folder anew; returns the exit code.

    Args:
        path: The log or folder.
        mcap: File for ROS 2 messages; of several episodes each has its seed in its file's name.
        hdf5: File for a data set of all episodes.
    """
    with results_only() as out, Messages(notices=False, warnings=True), user_errors():
        if not any((mcap, hdf5)):
            raise ValueError("say what to write: --mcap FILE.mcap or --hdf5 FILE.hdf5")
        from ..extras.export.data_sets import Hdf5DataSet, require

        files, results = logs_in(path), results_in(path)
        if mcap is not None:
            require("mcap")
            if mcap.suffix != ".mcap":
                raise ValueError(f"--mcap: must be a .mcap file, not '{mcap}'")
        data = Hdf5DataSet(hdf5) if hdf5 else None
        start_warp()
        from ..extras.export.data_sets import demonstration
        from ..extras.record.replay import require_plans
        from ..loop.log.run_log import RunLog

        seeds, episodes = [], []
        for file in files:  # all are looked at before anything is written
            log = RunLog.load(file)
            seeds.append(log.origin["seed"])
            result = results.get(seeds[-1], {})
            try:
                require_plans(log)
                if not len(log.controls):
                    raise ValueError("the episode has no control: it began at its end")
                if data:
                    episodes.append(demonstration(log, success=result.get("success"), reason=result.get("reason")))
            except ValueError as error:
                raise ValueError(f"{file}: {error}") from None
        if mcap is not None:
            from ..extras.export.mcap_file import write_mcap

            for file, seed in zip(files, seeds, strict=True):
                one = mcap.with_stem(f"{mcap.stem}-{seed}") if len(files) > 1 else mcap
                write_mcap(RunLog.load(file), one)
                say(one, out=out)
        if data:
            for episode in episodes:
                data.add(episode)
            data.close()
            say(f"{data.name}: {len(files)} episodes, {data.steps} steps", out=out)
    return SUCCESS


class SuccessfulRuns:
    """Data set of the episodes of a run that ended as they should; the others are counted and left out.

    Args:
        name: The file; ``.hdf5`` is added to a name without an ending.
    """

    def __init__(self, name: str):
        path = Path(name)
        self._path = path if path.suffix else path.with_name(f"{path.name}.hdf5")
        self._data: Hdf5DataSet | None = None
        self._kept = self._left_out = 0

    def open(self) -> None:
        """Begin the data set.

        Raises:
            ValueError: If it is there already, or a package is missing.
        """
        from ..extras.export.data_sets import Hdf5DataSet

        self._data = Hdf5DataSet(self._path)

    def add(self, log: RunLog, result: EpisodeResult) -> None:
        """Add an episode, if it ended as it should.

        Raises:
            OSError: If the data set cannot be written.
        """
        if not result.passed or not result.steps:
            self._left_out += 1
            return
        from ..extras.export.data_sets import demonstration

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
