# SPDX-License-Identifier: Apache-2.0
"""What ``warpmpc replay`` does: plan again what was logged and compare the commands, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from .interrupts import Interrupts
from .progress import Messages
from .run_folder import histories_in
from .setup import FAILURE, SUCCESS, results_only, start_warp, user_errors
from .terms import FolderTerms


def replay(path: Path, *, term_files: Sequence[Path]) -> int:
    """Replay the episodes of a file or a run's folder, report, and return the exit code.

    Args:
        path: History (``.npz``) or folder.
        term_files: Python files of cost terms.
    """
    same = True
    with results_only() as out, Messages(notices=False, warnings=False), Interrupts() as interrupts:
        try:
            with user_errors():
                files = histories_in(path)
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
        ValueError: If the file is no history that can be replayed.
    """
    from ..record.history import History
    from ..record.replay import replay as replay_log
    from ..record.replay import scene_of

    history = History.load(file)
    if history.log is not None:
        about, unknown = history.log.origin, 0
        parts = [replay_log(history.log, terms=terms.of(scene_of(about), planned=True))]
    elif history.made is not None:
        from ..record.real_time_replay import replay_real_time

        about = history.made.origin
        whole = replay_real_time(history, terms=terms.of(scene_of(about), planned=True))
        parts, unknown = [whole.plans, whole.commands], whole.unknown
    else:
        raise ValueError(
            f"{file}: has no log of what its plans were made from (an older warpmpc): run it again with --npz or --out"
        )
    for difference in parts[0].differences:
        if difference not in said:
            print(f"otherwise than in the log: {difference}", file=out)
            said.add(difference)
    agreed = " and ".join(f"{part.agree.sum()} of {len(part.agree)} {part.what}s" for part in parts)
    print(
        f"{file.name}: {about['scene']}{':' + about['variant'] if about['variant'] else ''}, seed {about['seed']}, "
        f"{about['engine']} on {about['device']}, {about['samples']} samples: {agreed} agree bit for bit",
        file=out,
    )
    for part in parts:
        if not part.same:
            print(f"  first that differs: {part.first}", file=out)
    if unknown:
        print(f"  the log lacks the plans of {unknown} commands", file=out)
    same = all(part.same for part in parts)
    if not same and parts[0].differences:
        print("  versions, source or hardware are not those of the log: then bits may differ", file=out)
    return same
