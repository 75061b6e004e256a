# SPDX-License-Identifier: Apache-2.0
"""What commands say of robots: a list, a look at one that sends nothing, and one clear error where one is not there."""

import json
import subprocess

import pytest
from program import PROGRAM, SCENE
from shared.wire import TRANSPORTS

from warpmpc.registry import ROBOTS
from warpmpc.robots import drivers


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "push.toml"
    path.write_text(SCENE, encoding="utf-8")
    return str(path)


@pytest.fixture
def lacking(monkeypatch):
    """Nothing that drivers need is installed."""
    monkeypatch.setattr(drivers, "find_spec", lambda name: None)


def one_line(done) -> str:
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    return line


def test_drivers_are_listed_with_where_they_come_from_and_their_keys(command, monkeypatch):
    def make(scene, **_):
        """A robot of mine.

        It is no other.
        """

    monkeypatch.setitem(ROBOTS, "mine", make)
    listed = command("robots").stdout
    assert "simulated (from warpmpc)" in listed
    assert "mine (from this program)\n  A robot of mine.\n" in listed
    assert "use_sim_time" not in listed
    assert "connect_timeout = number > 0; default 10.0" in command("robots", "zmq").stdout
    assert one_line(command("robots", "zmk")).startswith("error: no robot 'zmk'; there is: simulated, zmq")


def test_a_driver_without_its_package_says_how_to_get_it(command, scene, lacking):
    cure = 'needs zmq: pip install "warpmpc[transport]"'
    assert cure in command("robots").stdout
    for arguments in (["run", scene, "--real-time", "--robot", "zmq"], ["check", scene, "--robot", "zmq"]):
        assert one_line(command(*arguments)) == f"error: the robot 'zmq': {cure}"
    assert one_line(command("robot", scene, "--zmq", "5555")) == f"error: --zmq: {cure}"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["robot", "SCENE"], "a robot needs a transport: give --zmq PORT"),
        (
            ["robot", "SCENE", "--zmq", "5555", "--delay", "80..20"],
            "--delay: milliseconds, as 20 or 20..80, not '80..20'",
        ),
        (
            ["check", "SCENE", "--robot", "simulated:a.toml"],
            "the robot 'simulated': takes no file, but was given a.toml",
        ),
        (["check", "SCENE", "--robot", "zmq:none.toml"], "none.toml: cannot be read: No such file or directory"),
    ],
)
def test_what_cannot_be_is_one_line(command, scene, arguments, says):
    assert says in one_line(command(*(scene if word == "SCENE" else word for word in arguments)))


def test_a_look_at_a_robot_shows_what_it_sends_and_commands_nothing(command, scene, tmp_path, monkeypatch):
    monkeypatch.setattr("warpmpc.cli.robot.LISTEN", 1.0)
    ends = TRANSPORTS["zmq"]
    port, file = ends.place(), tmp_path / "robot.toml"
    file.write_text(ends.settings(port))
    robot = subprocess.Popen([*PROGRAM, "robot", scene, "--zmq", str(port)], stdout=subprocess.PIPE, text=True)
    try:
        done = command("check", scene, "--robot", f"zmq:{file}")
        assert done.returncode == 0, done.stderr
        shown = done.stdout
        assert f"tcp://127.0.0.1:{port}" in shown
        assert "base/yaw" in shown
        assert "box_free_joint: at 1.000, 0.000, 0.150 m, its z axis 0° from up" in shown
        file.write_text(ends.settings(port).replace("60.0", "0.5"))
        other = command("check", "cartpole_swingup", "--robot", f"zmq:{file}")
        assert "the state has no joint cart/slider, cart/hinge; it has base/x" in one_line(other)
        robot.terminate()
        report = json.loads(robot.communicate(timeout=60)[0])
    finally:
        robot.kill()
    assert (report["received"], report["reason"]) == (0, "never commanded")
    silent = command("run", scene, "--real-time", "--robot", f"zmq:{file}")
    assert f"nothing came from tcp://127.0.0.1:{port}: is the robot on" in one_line(silent)
