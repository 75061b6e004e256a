# SPDX-License-Identifier: Apache-2.0
"""What commands say of robots: a list, a look at one that sends nothing, and one clear error where one is not there."""

import json
import subprocess

import pytest
from needs import needs
from program import PROGRAM, SCENE
from shared.wire import TRANSPORTS

from warpmpc.loop.robots import drivers
from warpmpc.scene.registry import ROBOTS


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


@pytest.mark.parametrize(
    ("name", "option", "cure"),
    [
        ("zmq", ["--zmq", "5555"], 'needs zmq: pip install "warpmpc[transport]"'),
        ("ros2", ["--ros2"], 'needs rclpy: pip install "warpmpc[ros2]"'),
    ],
)
def test_a_driver_without_its_package_says_how_to_get_it(command, scene, lacking, name, option, cure):
    assert cure in command("robots").stdout
    for arguments in (["run", scene, "--real-time", "--robot", name], ["check", scene, "--robot", name]):
        assert one_line(command(*arguments)) == f"error: the robot '{name}': {cure}"
    assert one_line(command("robot", scene, *option)) == f"error: --{name}: {cure}"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["robot", "SCENE"], "a robot needs a transport: give --zmq PORT or --ros2"),
        (["robot", "SCENE", "--zmq", "5555", "--topics", "a.toml"], "--topics: goes with --ros2"),
        (
            ["check", "SCENE", "--robot", "simulated:a.toml"],
            "the robot 'simulated': takes no file, but was given a.toml",
        ),
        (["check", "SCENE", "--robot", "zmq:none.toml"], "none.toml: cannot be read: No such file or directory"),
    ],
)
def test_what_cannot_be_is_one_line(command, scene, arguments, says):
    assert says in one_line(command(*(scene if word == "SCENE" else word for word in arguments)))


SEEN = {
    "zmq": (
        "tcp://127.0.0.1:",
        "the state has no joint cart/slider, cart/hinge; it has base/x",
        "nothing came from tcp",
    ),
    "ros2": (
        "/box/odometry",
        "its messages have no joint slider, hinge; they have x, y, yaw",
        "nobody publishes /wire",
    ),
}
"""A source that is shown; what is said where another robot is there, and where none is."""


@pytest.mark.parametrize("transport", ["zmq", pytest.param("ros2", marks=needs("rclpy"))])
def test_a_look_at_a_robot_shows_what_it_sends_and_commands_nothing(command, scene, tmp_path, monkeypatch, transport):
    monkeypatch.setattr("warpmpc.cli.robot.LISTEN", 1.0)
    ends, (source, wrong, nothing) = TRANSPORTS[transport], SEEN[transport]
    place, file = ends.place(), tmp_path / "robot.toml"
    file.write_text(ends.settings(place))
    options = ends.options(place, file)
    robot = subprocess.Popen([*PROGRAM, "robot", scene, *options], stdout=subprocess.PIPE, text=True)
    try:
        done = command("check", scene, "--robot", f"{transport}:{file}")
        assert done.returncode == 0, done.stderr
        shown = done.stdout
        assert source in shown
        assert "base/yaw" in shown
        row = next(line for line in shown.splitlines() if "box_free_joint" in line)
        assert " ".join(row.split()) == "box_free_joint 1, 0, 0.15 m free joint, z axis 0° from up"
        seconds = {"zmq": "2.0", "ros2": "15.0"}[transport]  # nodes of ROS 2 may need seconds to find each other
        file.write_text(ends.settings(place).replace("60.0", seconds))
        assert wrong in one_line(command("check", "cartpole_swingup", "--robot", f"{transport}:{file}"))
        robot.terminate()
        report = json.loads(robot.communicate(timeout=60)[0])
    finally:
        robot.kill()
    assert (report["received"], report["reason"]) == (0, "never commanded")
    file.write_text(ends.settings(place).replace("60.0", "2.0"))
    assert nothing in one_line(command("run", scene, "--real-time", "--robot", f"{transport}:{file}"))
