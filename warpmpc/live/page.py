# SPDX-License-Identifier: Apache-2.0
"""The page: serves a session to any number of browsers until it is stopped."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from .access import open_server
from .drawing import Drawing
from .panels import Panels
from .plots import Plots
from .readouts import Readouts

if TYPE_CHECKING:
    import viser

    from .access import Access
    from .session import Session

RATE = 30.0
"""Pictures per second at most."""


def require_port(host: str, port: int) -> None:
    """Refuse a port that is taken.

    Raises:
        OSError: If nothing can listen there.
    """
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise OSError(f"cannot listen at {host}:{port} ({error.strerror}); choose another with --port") from None


def serve(
    session: Session, access: Access, *, ending: threading.Event | None = None, ready: Callable[[], None] = lambda: None
) -> None:
    """Start a session and show it until it ends, ``ending`` is set or Ctrl-C comes.

    Args:
        session: A session not yet started.
        access: Where to listen and who may look.
        ending: Ends it from another thread.
        ready: Called once browsers can connect.

    Raises:
        OSError: If the port is taken.
        ValueError: If requests cannot be checked with this version of viser.
    """
    import rich

    require_port(access.host, access.port)
    ending = ending or threading.Event()
    rich.get_console().quiet = True  # viser greets there
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # whoever connects and says nothing
    server = open_server(access, session.scene.title or session.scene.name)
    try:
        ready()
        session.start()
        _show(server, session, ending)
    finally:
        session.stop()
        if session.ident is not None:
            session.join(10.0)
        server.stop()


def _show(server: viser.ViserServer, session: Session, ending: threading.Event) -> None:
    """Send what changes until the session or somebody ends it."""
    source, due = None, time.perf_counter()
    while session.is_alive() and not ending.wait(max(0.0, due - time.perf_counter())):
        due = max(due + 1.0 / RATE, time.perf_counter())
        session.watched = bool(server.get_clients())
        snapshot = session.snapshot
        with server.atomic():
            if source != snapshot.source:  # other weights, other curves
                source = snapshot.source
                server.gui.reset()
                server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
                server.gui.set_panel_label(session.scene.title or session.scene.name)
                plots = Plots(server, session)
                parts = [Drawing(server, session, snapshot), Panels(server, session), plots]
                parts.append(Readouts(plots.panel, server, session))
            for part in parts:
                part.update(snapshot)
