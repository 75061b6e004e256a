# SPDX-License-Identifier: Apache-2.0
"""Hooks of MkDocs: what pages have from the source, and the package as an installed one has it for its docstrings."""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).parent))

from graph import drawn
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File
from reference import bodies, changelog

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
NAME = re.compile(r"^\* `(warpmpc[\w.]+)`: .*$", re.MULTILINE)
"""A name in the list of names, with what it is in a line."""
SHOWN = {"warpmpc.Scene": "[name, flat_poses, cost_labels]"}
"""Members of a class that the page shows, where it does not show all: keys of scene files have another page."""
_view = tempfile.TemporaryDirectory()
_bodies: dict[str, str] = {}


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
    """Write what comes from the source, and add the change log."""
    _bodies.update(bodies())
    files.append(File.generated(config, "changelog.md", content=changelog()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Draw graphs, put what comes from the source below what a page says by hand, and docstrings in place of lines."""
    markdown += _bodies.get(page.file.src_uri, "")
    return NAME.sub(_documented, drawn(markdown)) if page.file.src_uri == "reference/python.md" else drawn(markdown)


def _documented(name: re.Match[str]) -> str:
    members = SHOWN.get(name[1])
    return f"\n::: {name[1]}\n" + (f"    options:\n      members: {members}\n" if members else "")
