# SPDX-License-Identifier: Apache-2.0
"""An MCAP file, opened by the libraries of its format, holds the numbers of the run under their names."""

from collections import defaultdict

import numpy as np
import pytest
from needs import need

KINDS = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/odom/box": "nav_msgs/msg/Odometry",
    "/command": "std_msgs/msg/Float64MultiArray",
    "/plan": "trajectory_msgs/msg/JointTrajectory",
    "/plan/cost": "std_msgs/msg/Float64",
    "/task/goal": "geometry_msgs/msg/PoseStamped",
    "/scene": "visualization_msgs/msg/MarkerArray",
}


@pytest.fixture(scope="module")
def file(log, tmp_path_factory):
    need("mcap")
    need("rosbags")
    from warpmpc.extras.export.mcap_file import write_mcap

    path = tmp_path_factory.mktemp("mcap") / "run.mcap"
    write_mcap(log, path)
    return path


@pytest.fixture(scope="module")
def topics(file):
    """Messages by topic, with their times [s], read by the definitions that the file itself brings."""
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    found, store = defaultdict(list), get_typestore(Stores.EMPTY)
    with open(file, "rb") as opened:
        reader = make_reader(opened)
        assert reader.get_header().profile == "ros2"
        for schema, channel, message in reader.iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            if schema.name not in store.fielddefs:
                types = get_types_from_msg(schema.data.decode(), schema.name)
                store.register({name: kind for name, kind in types.items() if name not in store.fielddefs})
            content = store.deserialize_cdr(message.data, schema.name)
            found[channel.topic].append((1e-9 * message.log_time, content))
    return found


def of(topics, name):
    """Times ``[n]`` and messages of a topic."""
    return [time for time, _ in topics[name]], [content for _, content in topics[name]]


def numbers(value) -> list[float]:
    """Numbers of a vector or a quaternion."""
    return [getattr(value, axis) for axis in "xyzw" if hasattr(value, axis)]


def pose_of(value) -> list[float]:
    return [*numbers(value.position), *numbers(value.orientation)]


def frames(topics, name):
    """Times and poses ``[n, 7]`` of a frame."""
    parts = [(t, part) for t, found in topics["/tf"] for part in found.transforms if part.child_frame_id == name]
    assert {part.header.frame_id for _, part in parts} == {"world"}
    assert [part.header.stamp.sec + 1e-9 * part.header.stamp.nanosec for _, part in parts] == [t for t, _ in parts]
    poses = [[*numbers(part.transform.translation), *numbers(part.transform.rotation)] for _, part in parts]
    return np.array([t for t, _ in parts]), np.array(poses)


def test_topics_have_the_types_of_ros(topics):
    assert {name: topics[name][0][1].__msgtype__ for name in KINDS} == KINDS


def test_poses_are_those_of_the_log_mocap_bodies_and_movable_obstacles_too(topics, log):
    for n, name in enumerate(log.names["bodies"]):
        times, poses = frames(topics, name)
        np.testing.assert_allclose(times, log.states.time, atol=1e-9)
        np.testing.assert_array_equal(poses, log.states.body_q[:, n])
    assert "r/marker" in log.names["bodies"]
    times, poses = frames(topics, "gate")
    np.testing.assert_allclose(times, [0.0, log.plans.time[4]], atol=1e-9)
    np.testing.assert_allclose(poses[:, 0], [0.0, 0.5])


def test_free_joints_move_as_their_odometry_says(topics, log):
    for name in ("r/frame", "box"):
        times, found = of(topics, f"/odom/{name}")
        poses = np.array([pose_of(part.pose.pose) for part in found])
        np.testing.assert_allclose(poses, log.states.body_q[:, log.names["bodies"].index(name)], atol=1e-6)
        assert {part.child_frame_id for part in found} == {name}
        for n in range(len(found) - 1):  # the origin of the body moves by the twist half way, in the body's own frame
            turn = rotation(poses[n, 3:]).T
            step = turn @ (poses[n + 1, :3] - poses[n, :3]) / (times[n + 1] - times[n])
            linear, angular = (
                0.5 * np.add(*(numbers(getattr(found[i].twist.twist, part)) for i in (n, n + 1)))
                for part in ("linear", "angular")
            )
            np.testing.assert_allclose(step, linear, atol=0.02 * np.linalg.norm(linear) + 2e-3)
            spin = turn @ rotation(poses[n + 1, 3:])
            skew = np.array([spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]]) / 2
            np.testing.assert_allclose(skew / (times[n + 1] - times[n]), angular, atol=0.02 * np.linalg.norm(angular))


def test_commands_and_plans_are_those_of_the_log(topics, log):
    times, commands = of(topics, "/command")
    np.testing.assert_allclose(times, log.states.time[:-1], atol=1e-9)
    np.testing.assert_array_equal([part.data for part in commands], log.controls.control)
    assert commands[0].layout.dim[0].label == ", ".join(log.names["controls"])
    _, plans = of(topics, "/plan")
    assert len(plans) == len(log.plans)
    for plan, row in zip(plans, log.plans, strict=True):
        assert plan.joint_names == log.names["controls"]
        np.testing.assert_array_equal([knot.effort for knot in plan.points], row.knots)
        starts = [knot.time_from_start.sec + 1e-9 * knot.time_from_start.nanosec for knot in plan.points]
        np.testing.assert_allclose(row.time + starts, row.knot_time, atol=2e-9)
        assert [len(knot.positions) for knot in plan.points] == [0] * len(plan.points)  # motors of the file's own
    np.testing.assert_array_equal([part.data for part in of(topics, "/plan/cost")[1]], log.plans.cost)
    assert log.names["terms"][1] == "box-height"
    terms = [[part.data for part in of(topics, f"/plan/cost/{name}")[1]] for name in ("distance", "box_height")]
    np.testing.assert_array_equal(np.transpose(terms), log.plans.terms)


def test_the_task_is_there_where_it_changes(topics, log):
    times, goals = of(topics, "/task/goal")
    np.testing.assert_allclose(times, log.plans.time[[0, 4]], atol=1e-9)
    np.testing.assert_allclose([pose_of(part.pose)[:2] for part in goals], [[0.0, 0.0], [0.2, -0.5]], atol=1e-7)
    assert [part.data for part in of(topics, "/task/pace")[1]] == [0.5, 0.75]


def test_shapes_are_markers_in_the_frames_of_their_bodies(topics):
    (scene,) = of(topics, "/scene")[1]
    found = {part.header.frame_id: part for part in scene.markers}
    assert set(found) == {"r/frame", "r/marker", "box", "gate", "world"}
    np.testing.assert_allclose(numbers(found["box"].scale), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(pose_of(found["gate"].pose), [0, 0, 0, 0, 0, 0, 1])
    post = np.array([numbers(corner) for corner in found["world"].points])
    np.testing.assert_allclose(np.ptp(post, axis=0), [0.2, 0.2, 1.4], atol=0.01)


def test_rosbags_reads_the_file_as_a_bag(file, log):
    from rosbags.highlevel import AnyReader

    with AnyReader([file]) as bag:
        assert {c.topic for c in bag.connections} >= set(KINDS)
        (joints,) = [c for c in bag.connections if c.topic == "/joint_states"]
        assert len(list(bag.messages([joints]))) == len(log.states)


def rotation(q: np.ndarray) -> np.ndarray:
    """Matrix of a quaternion (x, y, z, w)."""
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
