# SPDX-License-Identifier: Apache-2.0
"""``warpmpc replay``: logged runs are planned again and their commands compared, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from .interrupts import Interrupts
from .progress import Messages
from .run_folder import logs_in
from .setup import FAILURE, SUCCESS, results_only, start_warp, user_errors
from .terms import FolderTerms


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
    """Replay one episode and tell of it; returns whether all commands are the same.

    Raises:
        ValueError: If the file is no run log that can be replayed.
    """
    from ..log.run_log import RunLog
    from ..record.replay import logged_scene, require_plans
    from ..record.replay import replay as replay_log

    log = RunLog.load(file)
    try:
        require_plans(log)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    about, found = log.origin, replay_log(log, terms=terms.of(logged_scene(log), planned=True))
    for difference in found.differences:
        if difference not in said:
            print(f"otherwise than in the log: {difference}", file=out)
            said.add(difference)
    agreed = " and ".join(f"{part.agree.sum()} of {len(part.agree)} {part.what}s" for part in found.parts)
    print(
        f"{file.name}: {log.title}, {about['engine']} on {about['device']}, {about['samples']} samples: "
        f"{agreed} agree bit for bit",
        file=out,
    )
    for part in found.parts:
        if not part.same:
            print(f"  first that differs: {part.first}", file=out)
    if found.unknown:
        print(f"  the log lacks the plans of {found.unknown} commands", file=out)
    if not found.same and found.differences:
        print("  versions, source or hardware are not those of the log: then bits may differ", file=out)
    return found.same
