# SPDX-License-Identifier: Apache-2.0
"""``warpmpc live``: a session is built and its page served."""

from __future__ import annotations

import sys
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING

import typer

from ..scene.load import load_scene
from .interrupts import Interrupts
from .setup import RunArguments, begin, user_errors
from .terms import load_terms

if TYPE_CHECKING:
    from ..live.access import Access

NEEDED = ("viser", "tomlkit")
"""Packages of the extra ``live``."""


def live(arguments: RunArguments, *, host: str, port: int, seed: int) -> None:
    """Serve a scene's page until Ctrl-C or SIGTERM."""
    with Interrupts(), user_errors():
        missing = [name for name in NEEDED if find_spec(name) is None]
        if missing:
            raise ValueError(f"the page needs {' and '.join(missing)}: pip install 'warpmpc[live]'")
        from ..live.access import Access
        from ..live.page import require_port, serve
        from ..live.session import Session

        require_port(host, port)
        begin(
            load_scene(arguments.source, overrides=arguments.overrides),
            arguments.device,
            say=partial(print, file=sys.stderr),
            quick=True,
        )
        try:
            options = {"engine": arguments.engine, "device": arguments.device}
            options["terms"] = load_terms(arguments.term_files)
            session = Session(arguments.source, overrides=arguments.overrides, seed=seed, **options)
            access = Access(host, port)
            serve(session, access, ready=lambda: _say_where(access))
        except KeyboardInterrupt:
            typer.echo("ended")


def _say_where(access: Access) -> None:
    typer.echo(f"{access.url}  (Ctrl-C ends it)")
    if not access.local:
        typer.echo("Other machines can reach this page: whoever has this URL with its token can use it. Not encrypted.")
