# SPDX-License-Identifier: Apache-2.0
"""``warpmpc diagnose``: why the states that a run's planner foresaw are not those that came."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..scene.errors import SceneError
from .interrupts import Interrupts
from .progress import Messages
from .run_folder import logs_in
from .setup import SUCCESS, results_only, start_warp, user_errors
from .terms import FolderTerms


def diagnose(path: Path, *, term_files: Sequence[Path]) -> int:
    """Diagnose the episodes of a run log (``.runlog``, ``.npz``) or of a run's folder; returns the exit code."""
    with results_only() as out, Messages(notices=False, warnings=False), Interrupts() as interrupts:
        try:
            with user_errors():
                files = logs_in(path)
            start_warp()
            from ..doctor.diagnose import diagnose as diagnose_log
            from ..log.run_log import RunLog
            from ..model.compiled import compile_scene
            from ..record.replay import logged_scene
            from .report import print_diagnosis

            terms = FolderTerms(path, term_files)
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
