# SPDX-License-Identifier: Apache-2.0
"""What ``warpmpc replay`` does: plan again what was logged and compare the commands, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from .interrupts import INTERRUPTED, Interrupts
from .progress import Messages
from .run import FAILURE, SUCCESS, results_only, start_warp, user_errors
from .run_folder import histories_in, terms_in
from .terms import load_terms


def replay(path: Path, *, term_files: Sequence[Path]) -> int:
    """Replay the episodes of a file or a run's folder, report, and return the exit code.

    Args:
        path: History (``.npz``) or folder.
        term_files: Python files of cost terms; the folder's own if there are none.
    """
    same = True
    with results_only() as out, Messages(notices=False, warnings=False), Interrupts():
        try:
            with user_errors():
                files = histories_in(path)
                start_warp()
                terms = load_terms(term_files or terms_in(path))
            said: set[str] = set()
            for file in files:
                with user_errors():
                    same &= _replay_one(file, terms, said, out)
        except KeyboardInterrupt:
            return INTERRUPTED
    return SUCCESS if same else FAILURE


def _replay_one(file: Path, terms: Sequence, said: set[str], out: TextIO) -> bool:
    """Replay one episode and tell of it; returns whether all commands are the same.

    Raises:
        ValueError: If the file is no history that can be replayed.
    """
    from ..record.history import History
    from ..record.replay import replay as replay_log

    log = History.load(file).log
    if log is None:
        raise ValueError(
            f"{file}: has no log of what its plans were made from (an older warpmpc, or a run in real time): run it "
            "again with --npz or --out"
        )
    found = replay_log(log, terms=terms)
    for difference in found.differences:
        if difference not in said:
            print(f"otherwise than in the log: {difference}", file=out)
            said.add(difference)
    about = log.origin
    print(
        f"{file.name}: {about['scene']}{':' + about['variant'] if about['variant'] else ''}, seed {about['seed']}, "
        f"{about['engine']} on {about['device']}, {about['samples']} samples: "
        f"{found.agree.sum()} of {len(log)} commands agree bit for bit",
        file=out,
    )
    if not found.same:
        print(f"  first that differs: {found.first}", file=out)
        if found.differences:
            print("  versions, source or hardware are not those of the log: then bits may differ", file=out)
    return found.same
