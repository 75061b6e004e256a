# SPDX-License-Identifier: Apache-2.0
"""What runs have left: planned again, diagnosed, drawn.

Cost terms and ancillary controllers of runs that are read again.
"""

from __future__ import annotations

import importlib.util
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from ..cost.user_files import TermsError, load_terms
from ..physics.runtime.files import try_file
from ..scene.errors import SceneError
from ..scene.load import load_scene
from ..scene.registry import TERMS
from .interrupts import Interrupts
from .progress import Messages
from .run_folder import SCENE, logs_in, terms_in
from .setup import FAILURE, SUCCESS, results_only, start_warp, user_errors
from .terminal import say

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..scene.schema import Scene


class FolderTerms:
    """Cost terms and ancillary controllers of runs that are read again.

    Files in a run's folder are programs from an unknown author: they are executed if they were given, or if a scene
    needs them and the user at a terminal agrees.

    Args:
        path: A run log or a run's folder.
        given: Files that were given.

    Raises:
        TermsError: If one of those cannot be used.
    """

    def __init__(self, path: Path, given: Sequence[Path]):
        self._path, self._files = path, [*given]
        self._terms = load_terms(self._files) if given else None  # a scene may name what they register

    def of(self, scene: Scene, *, planned: bool) -> list[UserTerm]:
        """Return those that a scene needs.

        Args:
            planned: Whether plans are made; else what success, failures and phases look at is needed alone.

        Raises:
            TermsError: If files cannot be used, or are those of the folder and may not be executed.
        """
        missing = [] if self._files else _own(scene, planned=planned)
        if missing:
            self._files = _allowed(self._path, terms_in(self._path), missing)
        if self._terms is None and self._files:
            self._terms = load_terms(self._files)
        return self._terms or []


def _own(scene: Scene, *, planned: bool) -> list[str]:
    """Names of a scene's terms and ancillary controllers that warpmpc does not have."""
    labelled = zip(scene.cost_labels, scene.cost, strict=True)
    used = [cost.term for label, cost in labelled if planned or label in scene.watched_terms]
    used += [row.function for row in scene.planner.ancillary if planned and row.function is not None]
    return sorted({*used} - {*TERMS})


def _allowed(path: Path, files: list[Path], missing: list[str]) -> list[Path]:
    """Files of a folder that may be executed: all of them, once the user agrees.

    Raises:
        TermsError: If the user does not.
    """
    if not files:
        return []
    what, names = ", ".join(missing), ", ".join(repr(str(file)) for file in files)
    if sys.stdin.isatty() and sys.stderr.isatty():
        say(f"{path}: its scene needs {what}. These files are programs: {names}", out=sys.stderr)
        say("Execute them? [y/N] ", end="", out=sys.stderr)
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return files
    cure = " ".join(f"--terms {shlex.quote(str(file))}" for file in files)
    raise TermsError(
        f"{path}: its scene needs {what}; its files are not executed without consent: read them, then {cure}"
    )


def replay(path: Path, *, term_files: Sequence[Path]) -> int:
    """Replay the episodes of a run log (``.runlog``, ``.npz``) or of a run's folder; returns the exit code."""
    same = True
    with results_only() as out, Messages(notices=False, warnings=False), Interrupts() as interrupts:
        try:
            with user_errors():
                files = logs_in(path)
                start_warp()
                terms = FolderTerms(path, term_files)
            said: set[str] = set()
            for file in files:
                with user_errors():
                    same &= _replay_one(file, terms, said, out)
        except KeyboardInterrupt:
            return interrupts.code
    return SUCCESS if same else FAILURE


def _replay_one(file: Path, terms: FolderTerms, said: set[str], out: TextIO) -> bool:
    """Replay one episode and print the result; returns whether all commands are the same.

    Raises:
        ValueError: If the file is no run log that can be replayed.
    """
    from ..extras.record.replay import logged_scene, require_plans
    from ..extras.record.replay import replay as replay_log
    from ..loop.log.run_log import RunLog

    log = RunLog.load(file)
    try:
        require_plans(log)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    about, found = log.origin, replay_log(log, terms=terms.of(logged_scene(log), planned=True))
    for difference in found.differences:
        if difference not in said:
            say(f"otherwise than in the log: {difference}", out=out)
            said.add(difference)
    agreed = " and ".join(f"{part.agree.sum()} of {len(part.agree)} {part.what}s" for part in found.parts)
    say(
        f"{file.name}: {log.title}, {about['engine']} on {about['device']}, {about['samples']} samples: "
        f"{agreed} agree bit for bit",
        out=out,
    )
    for part in found.parts:
        if not part.same:
            say(f"  first that differs: {part.first}", out=out)
    if found.unknown:
        say(f"  the log lacks the plans of {found.unknown} commands", out=out)
    if not found.same and found.differences:
        say("  versions, source or hardware are not those of the log: then bits may differ", out=out)
    return found.same


def diagnose(path: Path, *, term_files: Sequence[Path]) -> int:
    """Diagnose the episodes of a run log (``.runlog``, ``.npz``) or of a run's folder; returns the exit code."""
    with results_only() as out, Messages(notices=False, warnings=False), Interrupts() as interrupts:
        try:
            with user_errors():
                files = logs_in(path)
                start_warp()
                terms = FolderTerms(path, term_files)
            from ..extras.doctor.diagnose import diagnose as diagnose_log
            from ..extras.record.replay import logged_scene
            from ..loop.log.run_log import RunLog
            from ..scene.model.compiled import compile_scene
            from .report import print_diagnosis

            for file in files:
                with user_errors():
                    log = RunLog.load(file)
                    if log.origin is None:
                        raise ValueError(f"{file}: it does not tell where it comes from: run it again with --out DIR")
                    scene = logged_scene(log)
                    own = terms.of(scene, planned=True)
                    try:
                        found, left_out = diagnose_log(log, scene, compile_scene(scene), terms=own)
                    except ValueError as error:
                        raise error if isinstance(error, SceneError) else ValueError(f"{file}: {error}") from None
                print_diagnosis(f"{file.name}: {log.title}", found, left_out, out)
        except KeyboardInterrupt:
            return interrupts.code
    return SUCCESS


def plot(path: Path, *, out: Path | None, term_files: Sequence[Path]) -> int:
    """Draw the episodes of a run log (``.runlog``, ``.npz``) or of a run's folder; returns the exit code.

    Args:
        path: The log or folder.
        out: Folder for the files, or a picture (``.png``) that shows the run in one.
        term_files: Files of users' own cost terms.
    """
    with results_only() as printed, Messages(notices=False, warnings=False), user_errors():
        files = logs_in(path)
        if importlib.util.find_spec("matplotlib") is None:
            raise ValueError('figures need matplotlib: pip install "warpmpc[plot]"')
        start_warp()
        from ..extras.record.plots import PICTURES, plot_log, plot_overview
        from ..extras.record.replay import logged_scene
        from ..loop.log.run_log import RunLog

        one = out is not None and out.suffix in PICTURES and not out.is_dir()
        if out is not None and not one and (out.suffix or out.is_file()) and not out.is_dir():
            raise ValueError(f"--out: {out} is no folder and no picture ({', '.join(PICTURES)})")
        if one:
            try_file(out)
        terms = FolderTerms(path, term_files)
        for file in files:
            log = RunLog.load(file)
            title = log.title or file.stem
            if one:
                picture = out.with_stem(f"{out.stem}-{file.stem}") if len(files) > 1 else out
                plot_overview(log, picture, title=title)
                say(picture, out=printed)
                continue
            here = path / SCENE if path.is_dir() else None
            scene = None if log.origin is None else logged_scene(log)
            if scene is None and here is not None and here.exists():
                scene = load_scene(here)
            folder = out or (path / "plots" if path.is_dir() else path.with_name(f"{path.stem}_plots"))
            folder = folder / file.stem if len(files) > 1 else folder
            own = terms.of(scene, planned=False) if scene else ()
            for written in plot_log(log, folder, title=title, scene=scene, terms=own):
                say(written, out=printed)
    return SUCCESS
