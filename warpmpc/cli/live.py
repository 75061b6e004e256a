# SPDX-License-Identifier: Apache-2.0
"""What ``warpmpc live`` does: build a session and serve its page."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from .interrupts import Interrupts
from .setup import start_warp, user_errors
from .terms import load_terms

if TYPE_CHECKING:
    from ..live.access import Access

NEEDED = ("viser", "tomlkit")
"""Packages of the extra ``live``."""


def live(
    source: str,
    *,
    host: str,
    port: int,
    overrides: Sequence[str],
    term_files: Sequence[Path],
    seed: int,
    engine: str,
    device: str,
) -> None:
    """Serve a scene's page until Ctrl-C or SIGTERM.

    Args:
        source: Scene and variant.
        host: Address to listen at.
        port: Port to listen at.
        overrides: ``KEY=VALUE`` texts.
        term_files: Python files of cost terms.
        seed: Seed of the first episode.
        engine: Engine of the rollouts.
        device: Device of the rollouts.
    """
    with Interrupts(), user_errors():
        missing = [name for name in NEEDED if find_spec(name) is None]
        if missing:
            raise ValueError(f"the page needs {' and '.join(missing)}: pip install 'warpmpc[live]'")
        from ..live.access import Access
        from ..live.page import require_port, serve
        from ..live.session import Session

        require_port(host, port)
        start_warp()
        try:
            session = Session(
                source, overrides=overrides, seed=seed, engine=engine, device=device, terms=load_terms(term_files)
            )
            access = Access(host, port)
            serve(session, access, ready=lambda: _say_where(access))
        except KeyboardInterrupt:
            typer.echo("ended")


def _say_where(access: Access) -> None:
    typer.echo(f"{access.url}  (Ctrl-C ends it)")
    if not access.local:
        typer.echo("Other machines can reach this page: whoever has this URL with its token can use it. Not encrypted.")
