# SPDX-License-Identifier: Apache-2.0
"""What ``warpmpc plot`` does: figures and a table of a run's histories."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

from ..scene.load import load_scene
from .progress import Messages
from .run_folder import SCENE, histories_in
from .setup import SUCCESS, results_only, start_warp, user_errors
from .terms import FolderTerms


def plot(path: Path, *, out: Path | None, term_files: Sequence[Path]) -> int:
    """Draw the episodes of a file or a run's folder; returns the exit code.

    Args:
        path: History (``.npz``) or folder.
        out: Folder for the figures, ``plots`` in the run's folder or beside the file, named after it, if None.
        term_files: Python files of cost terms.
    """
    with results_only() as printed, Messages(notices=False, warnings=False), user_errors():
        files = histories_in(path)
        if importlib.util.find_spec("matplotlib") is None:
            raise ValueError('figures need matplotlib: pip install "warpmpc[plot]"')
        start_warp()
        from ..record.history import History
        from ..record.plots import plot_history
        from ..record.replay import logged_scene

        terms = FolderTerms(path, term_files)
        for file in files:
            history = History.load(file)
            here = path / SCENE if path.is_dir() else None
            scene = None if history.log is None else logged_scene(history.log)
            if scene is None and here is not None and here.exists():
                scene = load_scene(here)
            folder = out or (path / "plots" if path.is_dir() else path.with_name(f"{path.stem}_plots"))
            folder = folder / file.stem if len(files) > 1 else folder
            own = terms.of(scene, planned=False) if scene else ()
            title = file.stem
            if history.log is not None:
                about = history.log.origin
                title = f"{about['scene']}{':' + about['variant'] if about['variant'] else ''}, seed {about['seed']}"
            for written in plot_history(history, folder, title=title, scene=scene, terms=own):
                print(written, file=printed)
    return SUCCESS
