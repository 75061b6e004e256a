# SPDX-License-Identifier: Apache-2.0
"""The programs of the page about real time: a MuJoCo loop of one's own, and a robot behind sockets."""

import json
import os
import socket
import subprocess
import sys

import pytest
from needs import need
from pages import files

from warpmpc.scene.load import load_scene

PAGE = "docs/tutorial/realtime.md"


@pytest.fixture
def program(tmp_path):
    """Starts a program of the page."""

    def start(name: str, *args: object) -> subprocess.Popen:
        (tmp_path / name).write_text(files(PAGE)[name], encoding="utf-8")
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen([sys.executable, name, *map(str, args)], cwd=tmp_path, env=os.environ, **pipes)

    return start


def free_port() -> int:
    """A port that is free, and the one after it."""
    while True:
        with socket.socket() as one, socket.socket() as other:
            one.bind(("127.0.0.1", 0))
            try:
                other.bind(("127.0.0.1", one.getsockname()[1] + 1))
            except OSError:
                continue
            return one.getsockname()[1]


def test_a_mujoco_loop_of_ones_own_is_a_robot(program):
    out, errors = program("own_mujoco.py", 1.5, 0.15).communicate(timeout=200)
    plans, _, rest = out.splitlines()[-1].partition(" plans")
    assert int(plans) > 10, errors
    assert float(rest.rpartition(" ")[2]) > -0.95, "hanging all the time"


def test_a_robot_behind_sockets_is_steered_by_valid_messages_alone(program):
    need("zmq")
    port = free_port()
    control = program("control.py", port, 0.15)
    cartpole = load_scene("cartpole_swingup").path.parent / "assets" / "cartpole.xml"
    robot = program("robot.py", cartpole, port, 2.0, 0.15)
    out, errors = robot.communicate(timeout=250)
    told, warned = control.communicate(timeout=60)
    came = json.loads(out.splitlines()[-1])
    assert came["received"] > 100, (errors, warned)
    assert came["highest"] > -0.9, "it never swung"
    assert "Traceback" not in warned
    assert int(told.splitlines()[-1].split()[0]) > 10
