# SPDX-License-Identifier: Apache-2.0
import re
import signal
import socket
import subprocess
import time
from contextlib import contextmanager
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from needs import reason
from program import PROGRAM
from shared.ports import free_port

viser = pytest.importorskip("viser", reason=reason("viser"))

from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

FAST = ["--set", "planner.samples=16", "--set", "planner.refine=false", "--set", "engine.threads=1"]
FAST += ["--engine", "mujoco", "--device", "cpu"]


@contextmanager
def page(*arguments, inherited=signal.SIG_DFL):
    """A page as a process, and its port; ``inherited`` is what it finds SIGINT set to."""
    port = free_port()
    command = [*PROGRAM, "live", "cylinder_push", "--port", str(port), *FAST, *arguments]

    def start() -> None:
        signal.signal(signal.SIGINT, inherited)

    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes, preexec_fn=start) as process:
        try:
            yield process, port
        finally:
            process.kill()  # a test that fails must not wait for it


def ended(process, number=signal.SIGINT):
    """What else is said once it is told to end."""
    process.send_signal(number)
    out, err = process.communicate(timeout=60.0)
    assert err == ""
    assert process.returncode == 0
    return out


def until_served(port):
    end = time.monotonic() + 60.0
    while True:
        assert time.monotonic() < end, "nobody listens"
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            break
        except OSError:
            time.sleep(0.1)


def status(url, **options):
    """Status with which a WebSocket is taken (101) or refused."""
    protocols = [f"viser-v{viser.__version__}"]
    try:
        with connect(url.replace("http", "ws", 1), subprotocols=protocols, max_size=None, **options) as joined:
            joined.recv(timeout=20.0)
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_the_printed_url_is_served_until_ctrl_c_and_nothing_else_is_said():
    with page(inherited=signal.SIG_IGN) as (process, port):
        said = process.stdout.readline()
        until_served(port)
        url, base = said.split()[0], f"http://127.0.0.1:{port}"
        found = [
            status(url),
            status(url, origin=base),
            status(f"{base}/"),
            status(url, origin="http://example.org"),
            status(url.replace("127.0.0.1", "example.org"), sock=socket.create_connection(("127.0.0.1", port))),
        ]
        with pytest.raises(HTTPError, match="403"):
            urlopen(base, timeout=20.0)
        time.sleep(0.3)  # it runs
        assert ended(process) == "ended\n"
    assert found == [101, 101, 403, 403, 403]
    assert re.fullmatch(rf"http://127\.0\.0\.1:{port}/\?token=[\w-]{{32,}}  \(Ctrl-C ends it\)\n", said)


def test_a_page_for_other_machines_says_so_and_sigterm_ends_it_too():
    with page("--host", "0.0.0.0") as (process, port):
        said = [process.stdout.readline() for _ in range(2)]
        until_served(port)
        assert status(f"http://127.0.0.1:{port}/") == 403
        assert status(said[0].split()[0].replace(socket.gethostname(), "127.0.0.1", 1)) == 101
        time.sleep(0.3)  # it runs
        assert ended(process, signal.SIGTERM) == "ended\n"
    assert "Other machines can reach this page" in said[1]
    assert "token" in said[1]
