# SPDX-License-Identifier: Apache-2.0
"""``warpmpc plot``: figures and a table of a run's logs."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

from ..scene.load import load_scene
from .progress import Messages
from .run_folder import SCENE, logs_in
from .setup import SUCCESS, results_only, start_warp, user_errors
from .terms import FolderTerms


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
        from ..log.run_log import RunLog
        from ..record.plots import PICTURES, plot_log, plot_overview
        from ..record.replay import logged_scene

        one = out is not None and out.suffix in PICTURES and not out.is_dir()
        if out is not None and not one and (out.suffix or out.is_file()) and not out.is_dir():
            raise ValueError(f"--out: {out} is no folder and no picture ({', '.join(PICTURES)})")
        terms = FolderTerms(path, term_files)
        for file in files:
            log = RunLog.load(file)
            here = path / SCENE if path.is_dir() else None
            scene = None if log.origin is None else logged_scene(log)
            if scene is None and here is not None and here.exists():
                scene = load_scene(here)
            own = terms.of(scene, planned=False) if scene else ()
            about = {"title": log.title or file.stem, "scene": scene, "terms": own}
            if one:
                picture = out.with_stem(f"{out.stem}-{file.stem}") if len(files) > 1 else out
                plot_overview(log, picture, **about)
                print(picture, file=printed)
                continue
            folder = out or (path / "plots" if path.is_dir() else path.with_name(f"{path.stem}_plots"))
            folder = folder / file.stem if len(files) > 1 else folder
            for written in plot_log(log, folder, **about):
                print(written, file=printed)
    return SUCCESS
