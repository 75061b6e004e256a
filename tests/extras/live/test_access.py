# SPDX-License-Identifier: Apache-2.0
"""Requests that a page answers and those that it refuses, of viser's real server."""

import http.client
import socket

import pytest
from needs import reason
from shared.ports import free_port

viser = pytest.importorskip("viser", reason=reason("viser"))

from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from warpmpc.extras.live.page import (  # noqa: E402
    Access,
    open_server,
    require_port,
)


@pytest.fixture(scope="module")
def access():
    """A page that is served."""
    port = free_port()
    access = Access("127.0.0.1", port)
    server = open_server(access, "a page")
    yield access
    server.stop()


def get(access, path, **headers):
    """Status, headers and text of a file that is asked for."""
    page = http.client.HTTPConnection("127.0.0.1", access.port, timeout=20.0)
    page.request("GET", path, headers={"Host": f"127.0.0.1:{access.port}", **headers})
    response = page.getresponse()
    text = response.read().decode()
    page.close()
    return response.status, response.headers, text


def joined(access, *, path="/", host="127.0.0.1", origin=None, cookie=None):
    """Status with which a WebSocket is taken (101) or refused."""
    headers = {} if cookie is None else {"Cookie": cookie}
    try:
        with (
            socket.create_connection(("127.0.0.1", access.port), timeout=20.0) as line,
            connect(
                f"ws://{host}:{access.port}{path}",
                sock=line,
                origin=origin,
                additional_headers=headers,
                subprotocols=[f"viser-v{viser.__version__}"],
                max_size=None,
            ) as page,
        ):
            page.recv(timeout=20.0)
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_the_printed_url_opens_the_page_and_its_cookie_the_websocket(access):
    path = "/" + access.url.split("/", 3)[3]
    status, headers, text = get(access, path)
    assert status == 200
    assert "<html" in text
    cookie, *terms = headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} <= set(terms)
    origin = f"http://127.0.0.1:{access.port}"
    assert joined(access, cookie=f'other=a b"c; {cookie}', origin=origin) == 101
    assert get(access, "/", Cookie=cookie)[0] == 200, "the page again, without the token in its URL"
    assert joined(access, path=path) == 101, "no browser"


@pytest.mark.parametrize("token", ["", "?token=", "?token=wrong", "?token=%ff%00\u00e9", "?other=1"])
def test_nothing_is_answered_without_the_token(access, token):
    path = "/" + token.encode("ascii", "backslashreplace").decode()
    status, headers, text = get(access, path)
    assert status == 403
    assert "Set-Cookie" not in headers
    assert "token" in text
    assert access.token not in text
    assert joined(access, path=path) == 403
    assert joined(access, path=path, cookie=f"warpmpc-{access.port}=wrong; other={access.token}") == 403


@pytest.mark.parametrize("origin", ["http://example.org", "http://127.0.0.1:1", "http://localhost", "null"])
def test_pages_of_other_sites_are_refused_with_the_token_too(access, origin):
    path = f"/?token={access.token}"
    assert joined(access, path=path, origin=origin) == 403
    assert get(access, path, Origin=origin)[0] == 403


@pytest.mark.parametrize(
    "host", ["example.org", "127.0.0.1.example.org", "localhost.example.org", "a@example.org", "["]
)
def test_names_that_are_not_this_page_s_are_refused(access, host):
    status, headers, _ = get(access, f"/?token={access.token}", Host=host)
    assert status == 403
    assert "Set-Cookie" not in headers


def test_another_site_s_name_that_leads_here_is_refused(access):
    path, host = f"/?token={access.token}", "rebound.example.org"
    assert joined(access, path=path, host=host, origin=f"http://{host}:{access.port}") == 403


@pytest.mark.parametrize("host", ["localhost:9000", "LOCALHOST", "[::1]:9000", "192.0.2.7:8080", socket.gethostname()])
def test_addresses_and_names_of_this_computer_are_answered(access, host):
    assert get(access, f"/?token={access.token}", Host=host, Origin=f"http://{host}")[0] == 200


@pytest.mark.parametrize(
    ("host", "shown", "local"),
    [
        ("127.0.0.1", "127.0.0.1", True),
        ("localhost", "localhost", True),
        ("::1", "[::1]", True),
        ("0.0.0.0", socket.gethostname(), False),
        ("::", socket.gethostname(), False),
        ("192.0.2.7", "192.0.2.7", False),
        ("lab.example.org", "lab.example.org", False),
    ],
)
def test_the_url_names_an_address_that_browsers_understand(host, shown, local):
    access = Access(host, 8080)
    assert access.url == f"http://{shown}:8080/?token={access.token}"
    assert access.local is local
    assert len(access.token) >= 32
    assert Access(host, 8080).token != access.token


def test_a_port_that_is_taken_meanwhile_is_not_left_for_another(access):
    with pytest.raises(OSError, match="choose another with --port"):
        open_server(Access("127.0.0.1", access.port), "a page")


def test_a_viser_that_serves_in_another_way_is_not_used(monkeypatch):
    stopped = []

    class Other:
        def __init__(self, **_):
            self.stop = lambda: stopped.append(self)

    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(ValueError, match="pip install"):
        open_server(Access("127.0.0.1", 8080), "a page")
    assert stopped


def test_a_taken_port_is_refused():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(OSError, match="choose another with --port"):
            require_port("127.0.0.1", taken.getsockname()[1])
