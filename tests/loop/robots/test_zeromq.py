# SPDX-License-Identifier: Apache-2.0
"""Both ends of the ZeroMQ sockets: states and commands as they were sent, and what is no message."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
import zmq
from shared.ports import free_port
from small_scenes import BOX, compiled, make_scene

from warpmpc import SceneError, State
from warpmpc.loop.estimation.measurement import PoseMeasured
from warpmpc.loop.estimation.scene_estimator import LONGEST
from warpmpc.loop.robots.drivers import await_state, make_robot
from warpmpc.loop.robots.zeromq import LARGEST, MOST, TOLD, StateCodec, ZmqTransport
from warpmpc.scene.schema_estimate import Estimate

SCENE = make_scene(object=[BOX])


@pytest.fixture
def config(tmp_path):
    """A driver's file, and the port that it names."""
    port, file = free_port(), tmp_path / "robot.toml"
    ports = f'states = "tcp://127.0.0.1:{port}"\ncommands = "tcp://127.0.0.1:{port + 1}"\n'
    file.write_text(ports + "connect_timeout = 0.3\n")
    return file, port


@pytest.fixture
def ends(config):
    """A robot's end, which publishes, and the driver's."""
    file, port = config
    transport = ZmqTransport(compiled(SCENE).layout, port)
    robot = make_robot(f"zmq:{file}", SCENE, compiled=compiled(SCENE))
    yield transport, robot
    transport.close()
    robot.close()


def a_state(seed: int, moment: float = 4.0) -> State:
    layout, rng = compiled(SCENE).layout, np.random.default_rng(seed)
    q, qd = rng.normal(size=layout.nq).astype(np.float32), rng.normal(size=layout.nv).astype(np.float32)
    return State(q, qd, time=moment, act=layout.act, mocap=layout.mocap)


def meet(transport, robot, state: State) -> State:
    """Publish until the driver has seen it."""
    until = time.monotonic() + 10.0
    while (seen := robot.observe()) is None or seen.time != state.time:
        assert time.monotonic() < until, robot.heard()
        transport.publish(state)
        time.sleep(0.01)
    return seen


def hear(transport, robot, send) -> list:
    """Commands that came after something was sent, again and again until the sockets know each other."""
    until, came = time.monotonic() + 10.0, []
    while not came:
        assert time.monotonic() < until
        send()
        time.sleep(0.01)
        came = list(transport.receive(0.0))
    return came


@pytest.mark.parametrize("seed", range(3))
def test_states_and_commands_arrive_as_they_were_sent(ends, seed):
    transport, robot = ends
    assert robot.observe() is None
    sent = a_state(seed)
    seen = meet(transport, robot, sent)
    np.testing.assert_array_equal(seen.joint_q, sent.joint_q)
    np.testing.assert_array_equal(seen.joint_qd, sent.joint_qd)
    control = np.random.default_rng(seed).normal(size=3).astype(np.float32)
    command = hear(transport, robot, lambda: robot.apply(control))[0]
    np.testing.assert_array_equal(command.control, control)
    assert command.stamp == sent.time


def test_of_two_states_the_newer_counts_but_a_clock_that_was_set_is_passed_on(ends):
    transport, robot = ends
    meet(transport, robot, a_state(0, 4.0))
    transport.publish(a_state(1, 3.9))
    meet(transport, robot, a_state(2, 4.1))
    transport.publish(a_state(1, 4.05))
    time.sleep(0.1)
    assert robot.observe().time == 4.1
    assert meet(transport, robot, a_state(0, 1.0)).time == 1.0


def test_a_state_with_a_time_that_is_wrong_holds_up_none_after_it(ends):
    transport, robot = ends
    meet(transport, robot, a_state(0, 4.0))
    for wrong in (4.6, -100.0, 500.0):
        meet(transport, robot, a_state(1, wrong))  # the watchdog reports it
        transport.publish(a_state(2, 4.01))
        time.sleep(0.02)
        meet(transport, robot, a_state(2, 4.02))


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"\xff{",
        b"[]",
        b'{"time": 4.0}',
        b'{"time": 4.0, "sender": "a", "control": {"base/x": 1.0}}',
        b'{"time": 4.0, "sender": "a", "control": {"base/x": 1.0, "base/y": 1.0, "base/yaw": 1.0, "arm/j": 1.0}}',
        b'{"time": 4.0, "sender": "a", "control": {"base/x": "fast", "base/y": 1.0, "base/yaw": 1.0}}',
    ],
)
def test_what_is_no_command_of_this_robot_has_no_values(ends, message):
    transport, robot = ends
    (command, *_) = hear(transport, robot, lambda: robot._commands.send(message))
    assert command.control.shape == (0,)


def spoilt(spoil) -> bytes:
    message = json.loads(StateCodec(compiled(SCENE).layout).encode(a_state(0)))
    spoil(message)
    return json.dumps(message).encode()


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda m: m["joints"].pop("base/y"), "the state has no joint base/y; it has base/x, base/yaw"),
        (lambda m: m["joints"]["base/x"].update(q=[1.0, 2.0]), "joint base/x has 1 coordinates and 1 velocities"),
        (lambda m: m.pop("time"), "a message is no state: time: Field required"),
        (lambda m: m["joints"].update({"base/x": 1.0}), "a message is no state: joints.base/x"),
    ],
)
def test_states_that_do_not_fit_are_dropped_and_told_of(ends, spoil, says):
    transport, robot = ends
    until = time.monotonic() + 10.0
    while not robot.heard()[0].refused:
        assert time.monotonic() < until
        transport._states.send(spoilt(spoil))
        assert robot.observe() is None
    assert says in robot.heard()[0].missing
    with pytest.raises(ValueError, match=r"the robot 'zmq' is not there after 0\.3 s"):
        await_state(robot, "zmq")


def test_numbers_that_are_none_go_through_for_the_watchdog_to_see(ends):
    transport, robot = ends
    state = a_state(0)
    state.joint_q[0] = np.nan
    assert np.isnan(meet(transport, robot, state).joint_q[0])


def test_a_port_that_never_speaks_is_named(config):
    file, port = config
    robot = make_robot(f"zmq:{file}", SCENE, compiled=compiled(SCENE))
    with pytest.raises(ValueError, match=f"nothing came from tcp://127.0.0.1:{port}: is the robot on"):
        await_state(robot, "zmq")
    robot.close()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("state = 'tcp://127.0.0.1:1'", "state: unknown key; .*Did you mean 'states'"),
        ("states = 5555", "states: must be text in quotes; found 5555"),
        ("states = 'localhost'", "states: is no address .*such as tcp://127.0.0.1:5555; found 'localhost'"),
        ("states = ", "robot.toml:1: is not valid TOML"),
    ],
)
def test_mistakes_in_the_file_are_told_with_file_and_key(tmp_path, text, says):
    file = tmp_path / "robot.toml"
    file.write_text(text)
    with pytest.raises(SceneError, match=f"robot.toml.*{says.removeprefix('robot.toml')}"):
        make_robot(f"zmq:{file}", SCENE, compiled=compiled(SCENE))


def test_a_port_that_is_taken_is_named(ends, config):
    with pytest.raises(ValueError, match=rf"port {config[1]}: .*choose another with --zmq PORT"):
        ZmqTransport(compiled(SCENE).layout, config[1])


def test_measured_poses_are_estimated_from_and_old_ones_make_an_old_state(config):
    file, port = config
    estimate = {"noise": {"position": 0.01, "rotation": 0.01}, "process": {"linear": 0.02, "angular": 0.02}}
    scene = SCENE.model_copy(update={"estimate": {"box": Estimate(**estimate)}})
    transport = ZmqTransport(compiled(SCENE).layout, port)
    robot = make_robot(f"zmq:{file}", scene, compiled=compiled(SCENE))
    rng, state = np.random.default_rng(0), a_state(0, moment=-0.01)
    place, turn = np.array([0.5, -0.2, 0.1]), [0.0, 0.0, np.sin(0.2), np.cos(0.2)]
    try:
        meet(transport, robot._robot, state)
        assert robot.observe() is None  # nothing was measured yet
        with pytest.raises(ValueError, match="measured poses of box"):
            await_state(robot, "zmq")
        newest, until = 59 / 30, time.monotonic() + 20.0
        for k in range(60):
            transport.tell([PoseMeasured("box", k / 30, np.r_[place + rng.normal(0.0, 0.01, 3), turn])])
            if k % 4 == 0 or k == 59:  # a slow listener, who hears the newest message alone
                while robot.heard()[-1].stamp != k / 30:
                    assert time.monotonic() < until
                    transport.publish(replace(state, time=2.0 if k == 59 else k / 30))
                    robot.observe()
                    time.sleep(0.005)
        assert robot.heard()[-1].count == 60
        seen = robot.observe()
        np.testing.assert_allclose(seen.joint_q[-7:-4], place, atol=0.01)
        np.testing.assert_allclose(seen.joint_q[-4:], turn, atol=0.01)
        np.testing.assert_allclose(seen.joint_qd[-6:], 0.0, atol=0.05)
        np.testing.assert_array_equal(seen.joint_q[:-7], state.joint_q[:-7])
        assert seen.time == 2.0
        while seen.time == 2.0:
            assert time.monotonic() < until
            transport.publish(replace(state, time=4.0))
            seen = robot.observe()
            time.sleep(0.005)
        assert seen.time == pytest.approx(newest + LONGEST)  # the watchdog sees that nobody sees the box
    finally:
        transport.close()
        robot.close()


@pytest.mark.parametrize(
    ("sender", "count", "most"), [("flood", 500, MOST), ("x" * (LARGEST // 4), 50, 4)], ids=["many", "long"]
)
def test_a_flood_of_commands_is_read_in_part(ends, sender, count, most):
    transport, _ = ends
    context = zmq.Context()
    flood = context.socket(zmq.PUB)
    flood.connect(transport._commands.last_endpoint.decode())
    message = json.dumps({"time": 1.0, "sender": sender, "control": {}}).encode()
    deadline = time.monotonic() + 5.0
    while not list(transport.receive(1.0)) and time.monotonic() < deadline:
        flood.send(message)
    for _ in range(count):
        flood.send(message)
    time.sleep(0.1)
    assert 0 < len(list(transport.receive(1.0))) <= most
    context.destroy(linger=0)


def test_measured_poses_that_nobody_asks_for_are_not_kept_for_ever(ends):
    transport, robot = ends
    meet(transport, robot, a_state(0))
    for n in range(20):
        poses = [PoseMeasured("box", 5.0 + n + k / 500.0, np.eye(7)[6]) for k in range(120)]
        state = replace(a_state(0), time=5.0 + n)
        transport.tell(poses)
        deadline = time.monotonic() + 5.0
        while robot.observe().time != state.time and time.monotonic() < deadline:
            transport.publish(state)
            time.sleep(0.002)
    assert len(robot.measurements()) <= TOLD
