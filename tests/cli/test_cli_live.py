# SPDX-License-Identifier: Apache-2.0
import signal
import socket
import subprocess
import time

import pytest
from needs import reason
from program import PROGRAM

pytest.importorskip("viser", reason=reason("viser"))


def test_the_page_is_served_until_ctrl_c_and_nothing_else_is_said():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [*PROGRAM, "live", "cylinder_push", "--port", str(port), "--set", "planner.samples=16"]
    command += ["--set", "engine.threads=1", "--engine", "fused", "--device", "cpu"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as page:
        said = page.stdout.readline()
        end = time.monotonic() + 60.0
        while True:
            assert time.monotonic() < end, "nobody listens"
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
                break
            except OSError:
                time.sleep(0.1)
        time.sleep(1.0)  # it runs
        page.send_signal(signal.SIGINT)
        out, err = page.communicate(timeout=60.0)
    assert said == f"http://127.0.0.1:{port}  (Ctrl-C ends it)\n"
    assert out == "ended\n"
    assert err == ""
    assert page.returncode == 0
