# SPDX-License-Identifier: Apache-2.0
"""A robot and a planner as two processes: goals are reached, and after any fault the robot is safe in 100 ms.

Slow ones by hand: pytest -m slow tests/loop/robots/test_wire.py
"""

import json
import signal

import pytest
from needs import needs
from shared.wire import DRILL, Drill
from studies.plants.wire import SPOILT, run_pair

from warpmpc.loop.robots.safety import COMMANDS_TIMEOUT

SPEED = 0.25
"""The robot's seconds in a second: tests share their cores with others."""
SOON = COMMANDS_TIMEOUT + 1e-6
WINDOW = 0.2
"""Time for which things go wrong [s]."""
ROS2 = pytest.param("ros2", marks=needs("rclpy"))


@pytest.fixture(scope="module", params=["zmq", ROS2])
def pair(request, tmp_path_factory):
    """A robot on a long way and its planner."""
    with Drill(request.param, tmp_path_factory.mktemp("drill"), speed=SPEED) as pair:
        yield pair


@pytest.mark.parametrize("title", SPOILT)
def test_a_robot_whose_messages_are_spoilt_is_safe_soon_and_goes_on(pair, title):
    pair.order("await")
    answer = pair.order(SPOILT[title], WINDOW)
    assert answer["safe_s"] is not None
    assert answer["safe_s"] <= SOON
    assert answer["unsafe"] == 0
    pair.order("await")


def test_a_second_sender_is_refused_and_the_first_is_followed(pair):
    answer = pair.interfere(WINDOW)
    assert answer["refused"]["foreign"] > 5
    assert answer["unsafe"] == 0
    pair.order("await")


def test_a_robot_whose_planner_stops_or_is_killed_is_safe_soon(pair):
    pair.order("await")
    pair.planner.send(signal.SIGSTOP)
    stopped = pair.order("watch", WINDOW)
    pair.planner.send(signal.SIGCONT)
    pair.order("await")
    pair.planner.send(signal.SIGKILL)
    killed = pair.order("watch", WINDOW)
    for answer in (stopped, killed):
        assert answer["safe_s"] <= SOON
        assert answer["unsafe"] == 0
    report = pair.order("end")
    assert report["unsafe"] == 0
    assert report["safe_state_s"] <= SOON
    assert json.dumps(report, allow_nan=False)


def check_goal(scene: str, transport: str, seed: int, *, speed: float = SPEED, **keys) -> None:
    result, report = run_pair(scene, transport, seed, speed=speed, **keys)
    assert (result["success"], report["success"]) == (True, True), (result, report)
    assert report["unsafe"] == 0
    assert report["received"] > 20  # trajectories come less often than ticks


@pytest.mark.parametrize("transport", ["zmq", ROS2])
def test_a_robot_in_another_process_reaches_its_goal(transport, tmp_path):
    (tmp_path / "near.toml").write_text(DRILL, encoding="utf-8")
    changes = ["goal.position=[0.6, 0.0]", "engine.name='mujoco'"]
    check_goal(str(tmp_path / "near.toml"), transport, 0, changes=changes)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["cartpole_swingup", "omni_push_box"])
@pytest.mark.parametrize("seed", [1, 2])
def test_robots_in_another_process_reach_their_goals(scene, seed):
    check_goal(scene, "zmq", seed)


@pytest.mark.slow
@needs("rclpy")
@pytest.mark.parametrize("transport", ["ros2", "ros2-trajectory"])
@pytest.mark.parametrize("scene", ["omni_push_box", "omni_push_box:measured", "panda_reach_pose", "quadruped_walk"])
def test_robots_behind_topics_reach_their_goals(scene, transport):
    check_goal(scene, transport, 1, changes=["engine.threads=1"])


@pytest.mark.slow
@needs("rclpy")
def test_a_quadruped_walks_by_its_unit_and_joints_behind_topics():
    check_goal("go2_walk:estimated", "ros2", 0, speed=0.1, changes=["engine.threads=1", "agent.rate=200"])
