# SPDX-License-Identifier: Apache-2.0
"""The page: serves a session to any number of browsers until it is stopped.

Checks of every request for the page, before viser answers it: token, Origin and Host.
"""

from __future__ import annotations

import ipaddress
import logging
import secrets
import socket
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from .drawing import Drawing
from .panels import Panels
from .readouts import Plots, Readouts

if TYPE_CHECKING:
    import viser

    from .session import Session

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    Hook = Callable[[ServerConnection, Request], Response | None]


class Access:
    """Address of a page and what a request must show to be answered there.

    Three things are checked, of files and of WebSockets:

    * the token, in the URL (``?token=``) or in the cookie that comes with a page asked for by such a URL: who does not
      know it, another user of this computer as well, gets nothing;
    * ``Origin``, which browsers add to what pages ask for: pages of other sites get nothing;
    * ``Host``: an IP address, ``localhost``, the name of this computer or the one given, so that another site's name
      that leads here (DNS rebinding) is none.

    Args:
        host: Address or name to listen at.
    """

    def __init__(self, host: str, port: int):
        self.host, self.port = host, port
        self.token = secrets.token_urlsafe(24)
        self._computer = socket.gethostname()
        self._names = {name.lower() for name in (host, "localhost", self._computer)}
        self._cookie = f"warpmpc-{port}"  # browsers send a cookie to all ports of a host

    @property
    def url(self) -> str:
        """URL of the page with its token."""
        address = _ip(self.host)
        host = self._computer if not self.host or (address and address.is_unspecified) else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/?token={self.token}"

    @property
    def local(self) -> bool:
        """True if this computer alone can reach the page."""
        address = _ip(self.host)
        return self.host.lower() == "localhost" if address is None else address.is_loopback

    def refusal(self, request: Request) -> str | None:
        """Reason why a request is not answered; None if it may be."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        name = _host_name(hosts[0]) if len(hosts) == 1 else ""
        if name not in self._names and _ip(name) is None:
            return (
                "This page is not served under this name: use the IP address, "
                "or start it with --host and the name. (Host)"
            )
        allowed = {f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")}
        if not {origin.lower() for origin in origins} <= allowed:
            return "Pages of other sites cannot use this one. (Origin)"
        if not any(map(self._is_token, [*_tokens(request), *self._cookies(request)])):
            return "This page needs a token: open the URL that was printed when it was started, all of it."
        return None

    def hook(self, answer: Hook | None) -> Hook:
        """Function that refuses a request or has it answered, for ``process_request`` of ``websockets``.

        Args:
            answer: What answers a request that may be answered; None leaves that to ``websockets``.
        """

        def checked(connection: ServerConnection, request: Request) -> Response | None:
            reason = self.refusal(request)
            if reason is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            response = None if answer is None else answer(connection, request)
            if response is not None and _tokens(request):
                cookie = f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
                response.headers["Set-Cookie"] = cookie
            return response

        return checked

    def _is_token(self, text: str) -> bool:
        return secrets.compare_digest(text.encode(errors="replace"), self.token.encode())

    def _cookies(self, request: Request) -> list[str]:
        pairs = [pair.strip().partition("=") for pair in ";".join(request.headers.get_all("Cookie")).split(";")]
        return [value for name, _, value in pairs if name == self._cookie]


def open_server(access: Access, label: str) -> viser.ViserServer:
    """Viser's server, with every request checked.

    Viser has no place for its own check. It serves by ``websockets.asyncio.server.serve``, which does have one, so
    that function is another one for as long as viser starts.

    Args:
        access: Where to listen and who may look.

    Raises:
        OSError: If the port was taken meanwhile.
        ValueError: If this version of viser does not start as expected; nothing is served then.
    """
    import viser
    from websockets.asyncio import server as websockets_server

    serve, checked = websockets_server.serve, []

    def serve_checked(*args: object, process_request: Hook | None = None, **options: object) -> object:
        checked.append(True)
        return serve(*args, process_request=access.hook(process_request), **options)

    websockets_server.serve = serve_checked
    try:
        server = viser.ViserServer(host=access.host, port=access.port, label=label, verbose=False)
    finally:
        websockets_server.serve = serve
    if not checked:
        server.stop()
        raise ValueError(f"the token cannot be checked with viser {viser.__version__}: pip install 'viser==1.1.1'")
    if server.get_port() != access.port:
        server.stop()
        raise OSError(f"cannot listen at {access.host}:{access.port} (taken meanwhile); choose another with --port")
    return server


def _tokens(request: Request) -> list[str]:
    return parse_qs(request.path.partition("?")[2]).get("token", [])


def _host_name(text: str) -> str:
    """Name or address of ``NAME:PORT``; empty if it is none."""
    try:
        return urlsplit(f"//{text}").hostname or ""
    except ValueError:
        return ""


def _ip(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


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
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # clients that connect and send nothing
    server = open_server(access, session.scene.title or session.scene.name)
    try:
        session.awaiting = True
        ready()
        session.start()
        _show(server, session, ending)
    finally:
        session.stop()
        if session.ident is not None:
            session.join(10.0)
        server.stop()


def _show(server: viser.ViserServer, session: Session, ending: threading.Event) -> None:
    """Send what changes until the session ends or is closed."""
    source, due = None, time.perf_counter()
    while session.is_alive() and not ending.wait(max(0.0, due - time.perf_counter())):
        due = max(due + 1.0 / RATE, time.perf_counter())
        session.watched = bool(server.get_clients())
        session.awaiting = session.awaiting and not session.watched
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
