# SPDX-License-Identifier: Apache-2.0
"""Files that ``warpmpc run`` writes of its episodes: run logs, also as CSV and NPZ, and recordings for rerun."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..log.files import try_file
from ..log.run_log import log_file
from ..record.run_recorder import RunRecorder
from ..record.switch import rerun_missing
from .run_folder import LOG, RECORDING, RunFolder, check_folder

if TYPE_CHECKING:
    import numpy as np

    from ..log.run_log import RunLog
    from ..run.episode import Episode, Recorder
    from ..run.result import EpisodeResult
    from ..scene.schema import Scene
    from .export import SuccessfulRuns

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
            for file in [files[0], *filter(Path.exists, files[1:])]:
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
            from ..record.recorder import Recorder as Recording  # slow to import

            made.append(Recording(path, episode.controller, episode.plant))
        return Recorders(made, log)

    def log(self, seed: int) -> Path | None:
        """File that the log of an episode is written to while it runs; None without a folder."""
        return None if self.out is None else self._path(self.out / LOG, seed)

    def save(self, log: RunLog, seed: int, result: EpisodeResult | None = None) -> None:
        """Write the log of an episode to the files that are not there yet, and to the data set with its result.

        Raises:
            OSError: If a file cannot be written.
        """
        folder = self.log(seed)
        for path in (self.csv, self.npz):
            if path is not None:
                log.save(self._path(path, seed))
        if folder is not None and not folder.exists():
            log.save(folder)
        if self.export is not None:
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
