# SPDX-License-Identifier: Apache-2.0
"""Hooks of MkDocs: pages written from the source, and the package as an installed one has it for its docstrings."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).parent))

from graph import drawn
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File
from reference import pages

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
_view = tempfile.TemporaryDirectory()


@event_priority(100)  # before mkdocstrings takes its settings
def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Show mkdocstrings a package that has its kernels inside, as an installed one does."""
    package = Path(_view.name) / "warpmpc"
    if not package.exists():
        for source, target in ((ROOT / "warpmpc", package), (ROOT / "kernels", package / "kernels")):
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [_view.name]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are written from the source."""
    for path, text in pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Draw graphs."""
    return drawn(markdown)
