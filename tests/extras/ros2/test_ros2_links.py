# SPDX-License-Identifier: Apache-2.0
"""Poses and twists of odometry against MuJoCo's own kinematics, and conversions of messages; needs no ROS."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from newton import JointType
from scipy.spatial.transform import Rotation

from warpmpc import MujocoStates, SceneError, State, load_scene
from warpmpc.extras.ros2.messages import (
    FloatingBody,
    JointOrder,
    Link,
    PlanarJoints,
    RosTime,
    difference,
    read_links,
    write_odometry,
)
from warpmpc.extras.ros2.settings import Ros2Settings
from warpmpc.extras.ros2.topics import Topics
from warpmpc.loop.estimation.free_joints import free_joints
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.mujoco_model import make_world

POSE = "geometry_msgs/PoseStamped"


def body_link(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Link:
    """The pose of a body's frame and its twist along its own axes, as MuJoCo says."""
    found = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, found, 1)
    turn = np.roll(data.xquat[body], -1)  # w comes first in MuJoCo, and angular velocity
    return Link(np.array([*data.xpos[body], *turn]), np.array([*found[3:], *found[:3]]))


@pytest.mark.parametrize("name", ["go2_walk", "omni_push_box"])
def test_odometry_is_what_mujoco_says_of_the_body(name):
    """The base of go2 has its centre of mass beside its origin."""
    scene = load_scene(name)
    compiled = compile_scene(scene)
    layout = compiled.layout
    model = make_world(compiled, timestep=0.01).model
    data, states = mujoco.MjData(model), MujocoStates(compiled, model)
    joints = free_joints(layout)
    assert joints
    rng = np.random.default_rng(0)
    for _ in range(5):
        state = State(layout.joint_q.copy(), rng.normal(size=layout.nv).astype(np.float32), time=0.0)
        for joint in joints.values():
            start = layout.joint_q_start[joint]
            state.joint_q[start : start + 3] += rng.normal(size=3)
            state.joint_q[start + 3 : start + 7] = Rotation.random(random_state=rng).as_quat()
        states.write(state, data)
        mujoco.mj_forward(model, data)
        for joint in joints.values():
            body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, layout.body_name[layout.joint_child[joint]])
            body = body if body >= 0 else _free_body(model, data, state, layout, joint)
            free, wanted = FloatingBody(layout, joint), body_link(model, data, body)
            found = free.link(state.joint_q[free.q], state.joint_qd[free.qd])
            np.testing.assert_allclose(found.pose[:3], wanted.pose[:3], atol=1e-5)
            assert abs(found.pose[3:] @ wanted.pose[3:]) == pytest.approx(1.0, abs=1e-6)
            np.testing.assert_allclose(found.twist, wanted.twist, atol=1e-5)
            q, qd = free.numbers(wanted)
            np.testing.assert_allclose(q[:3], state.joint_q[free.q][:3], atol=1e-5)
            np.testing.assert_allclose(qd, state.joint_qd[free.qd], atol=1e-5)


def _free_body(model, data, state, layout, joint):
    """The body of a free joint by where it is, for names in the model are not the scene's."""
    start = layout.joint_q_start[joint]
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    bodies = [int(model.jnt_bodyid[j]) for j in free]
    return min(bodies, key=lambda body: np.linalg.norm(data.xpos[body] - state.joint_q[start : start + 3]))


def test_a_base_on_wheels_is_told_by_its_odometry():
    layout = compile_scene(load_scene("omni_push_box")).layout
    base = PlanarJoints(layout, ("base/x", "base/y", "base/yaw"))
    turn = Rotation.from_euler("z", 0.7)
    forwards = turn.inv().apply([0.3, -0.2, 0.0])
    link = Link(np.array([1.0, 2.0, 0.1, *turn.as_quat()]), np.array([*forwards, 0.0, 0.0, 0.5]))
    q, qd = base.numbers(link)
    np.testing.assert_allclose(q, [1.0, 2.0, 0.7], atol=1e-12)
    np.testing.assert_allclose(qd, [0.3, -0.2, 0.5], atol=1e-12)
    back = base.link(q, qd)
    np.testing.assert_allclose(back.twist, link.twist, atol=1e-12)
    np.testing.assert_allclose(back.pose[3:], link.pose[3:], atol=1e-12)


def test_the_heading_of_a_base_on_wheels_counts_its_turns():
    layout = compile_scene(load_scene("omni_push_box")).layout
    base = PlanarJoints(layout, ("base/x", "base/y", "base/yaw"))
    for yaw in [*np.arange(0.0, 10.0, 0.7), *np.arange(10.0, -10.0, -0.7)]:
        turn = Rotation.from_euler("z", yaw).as_quat()
        assert np.isnan(base.numbers(Link(np.full(7, np.nan)))[0]).all()  # and a pose that is none changes nothing
        assert base.numbers(Link(np.array([0.0, 0.0, 0.0, *turn])))[0][2] == pytest.approx(yaw)


@pytest.mark.parametrize("seed", range(3))
def test_two_poses_tell_the_twist_between_them(seed):
    rng = np.random.default_rng(seed)
    start, dt = Rotation.random(random_state=rng), 0.02
    twist = rng.normal(size=6)  # of a body that keeps it
    end = start * Rotation.from_rotvec(twist[3:] * dt)
    before = Link(np.array([*rng.normal(size=3), *start.as_quat()]))
    after = Link(np.array([*(before.pose[:3] + end.apply(twist[:3]) * dt), *-end.as_quat()]))  # -q turns as q does
    np.testing.assert_allclose(difference(before, after, dt), twist, atol=1e-9)


def message(names, position, velocity=(), effort=()):
    return SimpleNamespace(name=list(names), position=position, velocity=velocity, effort=effort)


def test_joints_come_in_any_order_and_among_others():
    order = JointOrder(["a", "b", "c"])
    numbers = [9.0, 3.0, 1.0, 2.0], [0.9, 0.3, 0.1, 0.2], [90.0, 30.0, 10.0, 20.0]
    here, position, velocity, effort = order.read(message("xcab", *numbers))
    assert dict(zip(here.tolist(), position, strict=True)) == {0: 1.0, 1: 2.0, 2: 3.0}
    assert dict(zip(here.tolist(), velocity, strict=True)) == {0: 0.1, 1: 0.2, 2: 0.3}
    assert dict(zip(here.tolist(), effort, strict=True)) == {0: 10.0, 1: 20.0, 2: 30.0}
    here, position, velocity, effort = order.read(message("b", [5.0]))
    assert (here.tolist(), position.tolist(), velocity, effort) == ([1], [5.0], None, None)
    with pytest.raises(ValueError, match="2 names, 1 positions"):
        order.read(message("ab", [5.0]))
    with pytest.raises(ValueError, match="2 positions, 0 velocities, 1 efforts"):
        order.read(message("ab", [5.0, 6.0], [], [1.0]))


def test_time_stamps_keep_their_nanoseconds():
    clock = RosTime()
    stamp = SimpleNamespace(sec=1_795_634_020, nanosec=123_456_789)
    assert clock.seconds(stamp) == pytest.approx(0.123456789, abs=1e-12)
    later = SimpleNamespace(sec=0, nanosec=0)
    clock.write(86_400.000000001, later)
    assert (later.sec, later.nanosec) == (1_795_634_020 + 86_400, 1)
    assert clock.seconds(SimpleNamespace(sec=1_795_634_019, nanosec=0)) == -1.0


def nested(**fields):
    return SimpleNamespace(**{name: nested(**v) if isinstance(v, dict) else v for name, v in fields.items()})


def test_links_are_read_from_each_type_of_message():
    point, turn = {"x": 1.0, "y": 2.0, "z": 3.0}, {"x": 0.0, "y": 0.0, "z": 2.0, "w": 0.0}
    stamp = SimpleNamespace(sec=5, nanosec=0)
    header = {"stamp": stamp, "frame_id": "world"}
    pose = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0])
    odometry = nested(
        header=header,
        pose={"pose": {"position": point, "orientation": turn}},
        twist={"twist": {"linear": point, "angular": point}},
    )
    write_odometry(Link(pose, np.arange(6.0)), odometry)
    ((at, link),) = read_links("nav_msgs/Odometry", odometry, "", "world")
    assert at is stamp
    np.testing.assert_array_equal(link.pose, pose)
    np.testing.assert_array_equal(link.twist, np.arange(6.0))
    here = nested(header=header, pose={"position": point, "orientation": turn})
    ((_, link),) = read_links(POSE, here, "", "world")
    np.testing.assert_array_equal(link.pose, pose)
    assert link.twist is None
    moved = {"translation": point, "rotation": turn}
    frames = [nested(header=header, child_frame_id=name, transform=moved) for name in ("cup", "box")]
    ((_, link),) = read_links("tf2_msgs/TFMessage", SimpleNamespace(transforms=frames), "box", "world")
    np.testing.assert_array_equal(link.pose, pose)
    frames[0].header.frame_id = here.header.frame_id = odometry.header.frame_id = "map"
    assert len(read_links("tf2_msgs/TFMessage", SimpleNamespace(transforms=frames), "box", "world")) == 1
    elsewhere = {POSE: here, "nav_msgs/Odometry": odometry, "tf2_msgs/TFMessage": SimpleNamespace(transforms=frames)}
    for kind, message in elsewhere.items():
        with pytest.raises(ValueError, match=r"in the frame 'map', not 'world': .* set world = \"map\""):
            read_links(kind, message, "cup", "world")
        assert len(read_links(kind, message, "cup", "map")) == 1
    turn["z"] = 0.0
    here = nested(header=header, pose={"position": point, "orientation": turn})
    with pytest.raises(ValueError, match="quaternion of a pose is zero"):
        read_links(POSE, here, "", "world")


def test_joints_that_no_message_tells_are_refused():
    layout = compile_scene(load_scene("omni_push_box")).layout
    kinds = np.where(layout.joint_type == JointType.FREE, JointType.BALL, layout.joint_type)
    with pytest.raises(SceneError, match="no ROS message describes ball joints") as error:
        Topics.of(layout.replace(joint_type=kinds), Ros2Settings(), None)
    assert error.value.found == "box_free_joint"
