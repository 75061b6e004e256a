# SPDX-License-Identifier: Apache-2.0
"""MJCF files are simulated as their authors wrote them: the engine ``mujoco`` against plain MuJoCo on the same file."""

import mujoco
import numpy as np
import pytest
from native_robots import (
    CARTPOLE,
    LEG_DRIVE,
    QUADROTOR,
    compiled_native,
    driven_model,
    installed,
    mujoco_engine,
    native_scene,
    plain_model,
    plain_rollout,
    random_controls,
    roll,
    without_contact,
)

from warpmpc import SceneError
from warpmpc.physics.collisions import colliding_pairs
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.pairs import Pair

STEPS = 50


@pytest.fixture(scope="module")
def assets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("native")
    (folder / "quadrotor.xml").write_text(QUADROTOR)
    (folder / "cartpole.xml").write_text(CARTPOLE)
    return folder


def asset_file(name: str, assets):
    match name:
        case "humanoid" | "ant":
            return installed("newton", f"examples/assets/nv_{name}.xml")
        case "hand":
            return installed("gymnasium_robotics", "envs/assets/hand/reach.xml")
        case "hand and block":
            return installed("gymnasium_robotics", "envs/assets/hand/manipulate_block.xml")
        case "mjlab cartpole":
            return installed("mjlab", "tasks/cartpole/cartpole.xml")
    return assets / f"{name}.xml"


OWN_ACTUATORS = ["humanoid", "ant", "hand", "hand and block", "mjlab cartpole", "cartpole", "quadrotor"]


@pytest.mark.parametrize("contact", [False, True])
@pytest.mark.parametrize("name", OWN_ACTUATORS)
def test_a_file_is_simulated_as_plain_mujoco_does_it(name, contact, assets):
    path = asset_file(name, assets)
    compiled, model = compiled_native(path), plain_model(path)
    layout = compiled.layout
    engine = mujoco_engine(compiled, STEPS, model.opt.timestep)
    if not contact:
        without_contact(model)
        without_contact(engine.model)
    assert layout.control_name == tuple(f"r/{engine.model.actuator(a).name[2:]}" for a in range(model.nu))
    control = random_controls(compiled, STEPS)
    out = roll(engine, compiled, control)
    data = mujoco.MjData(model)
    data.qpos[:] = engine.initial[0, 1 : 1 + model.nq]  # as float32 has it
    expected = plain_rollout(model, data, control[:, 0])
    found = np.split(engine.state[0, :, 1:], np.cumsum([model.nq, model.nv, model.na]), axis=1)
    for values, key in zip(found, ("qpos", "qvel", "act"), strict=False):
        np.testing.assert_allclose(values, expected[key], rtol=1e-6, atol=1e-6, err_msg=key)
    # what terms see is float32
    np.testing.assert_allclose(out.body_q.numpy()[1:, 0, :, :3], expected["xpos"], rtol=1e-5, atol=5e-6)
    np.testing.assert_allclose(out.act.numpy()[1:, 0], expected["act"], atol=1e-6)
    scale = np.abs(expected["sensordata"]).max(initial=1.0)
    np.testing.assert_allclose(out.sensor.numpy()[:, 0], expected["sensordata"], atol=1e-6 * scale)


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
@pytest.mark.parametrize("place", [{}, {"position": (0.3, -0.2, 0.5), "rotation": (0.0, 0.0, 0.6, 0.8)}])
def test_a_keyframe_is_where_the_robot_starts_with_its_activations_and_controls(name, place, assets):
    path, key = assets / f"{name}.xml", {"cartpole": "down", "quadrotor": "hover"}[name]
    compiled, model = compiled_native(path, keyframe=key, **place), plain_model(path)
    layout, frame = compiled.layout, plain_model(path).key(key)
    np.testing.assert_allclose(layout.act, frame.act, atol=1e-7)
    np.testing.assert_allclose(layout.control_start, frame.ctrl, atol=1e-7)
    assert [k.name for k in layout.keyframes] == [f"r/{key}"]
    np.testing.assert_allclose(layout.keyframes[0].joint_q, layout.joint_q, atol=1e-6)
    np.testing.assert_allclose(layout.keyframes[0].mocap, layout.mocap.ravel(), atol=1e-6)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    control = random_controls(compiled, STEPS)
    engine = mujoco_engine(compiled, STEPS, model.opt.timestep)
    out = roll(engine, compiled, control)
    if not place:
        np.testing.assert_allclose(engine.initial[0, 1:], [*data.qpos, *data.qvel, *data.act], atol=1e-6)
        expected = plain_rollout(model, data, control[:, 0])
        np.testing.assert_allclose(out.sensor.numpy()[:, 0], expected["sensordata"], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(out.body_q.numpy()[1:, 0, :, :3], expected["xpos"], atol=1e-5)
    assert not out.diverged.numpy().any()


def test_sites_are_frames_and_sensors_are_read_by_name(assets):
    # the frame, which the file puts at z = 0.5, stands at the origin's height: the marker comes down with it
    layout = compiled_native(assets / "quadrotor.xml", position=(1.0, 2.0, 0.0)).layout
    assert {"r/frame", "r/imu", "r/thrust3", "r/marker", "r/beacon"} <= set(layout.frame_name)
    imu = layout.frame("r/imu")
    np.testing.assert_allclose(layout.frame_pose[imu][:3], [0.0, 0.0, 0.02], atol=1e-6)
    assert layout.frame_body[imu] == layout.body_name.index("r/frame")
    assert (layout.sensor("accelerometer"), layout.sensor("r/attitude"), layout.ns) == (3, 6, 13)
    with pytest.raises(SceneError, match="no such sensor"):
        layout.sensor("compass")
    assert layout.mocap_name == ("r/marker",)
    np.testing.assert_allclose(layout.mocap[0], [2.0, 2.0, 0.5, 0.0, 0.0, 0.8, 0.6], atol=1e-6)


def test_sensors_that_nobody_reads_are_not_simulated(assets):
    compiled = compiled_native(assets / "quadrotor.xml")
    engine = mujoco_engine(compiled, 3, 0.004, sensors=("r/way",))
    assert engine.model.nsensor == 1
    out = roll(engine, compiled, random_controls(compiled, 3))
    assert np.abs(out.sensor.numpy()[-1, 0, 10:]).min() > 0.1
    assert not out.sensor.numpy()[..., :10].any()


def test_a_position_servo_holds_where_it_is_and_other_actuators_rest(assets):
    layout = compiled_native(assets / "cartpole.xml").layout
    assert layout.control_name == ("r/slider", "r/hold", "r/pull")
    assert layout.control_safe.tolist() == [-1, layout.joint("r/hinge"), -1]
    assert layout.activation_name == ("r/pull",)
    np.testing.assert_allclose(layout.joint_q, [0.2, 0.3], atol=1e-6)


def test_an_actuator_without_limits_asks_for_them(tmp_path):
    path = tmp_path / "open.xml"
    path.write_text(CARTPOLE.replace('gear="10" ctrlrange="-1 1"', 'gear="10"'))
    with pytest.raises(SceneError, match=r"slider.*ctrlrange.*drive"):
        compiled_native(path)


def test_joints_that_newton_cannot_take_together_are_named(tmp_path):
    path = tmp_path / "odd.xml"
    path.write_text(
        "<mujoco><worldbody><body name='arm'><joint name='turn' type='hinge'/><joint name='slip' type='slide'/>"
        "<geom size='.1'/></body></worldbody><actuator><motor joint='turn' ctrlrange='-1 1'/></actuator></mujoco>"
    )
    with pytest.raises(SceneError, match=r"'arm' cannot be taken together: a slide comes after a hinge"):
        compiled_native(path)


def test_a_quadruped_of_mjlab_moves_on_its_drive_as_on_servos_of_its_file():
    path = installed("mjlab", "asset_zoo/robots/unitree_go1/xmls/go1.xml")
    compiled = compiled_native(path, drive=LEG_DRIVE)
    layout = compiled.layout
    model = driven_model(path, layout.control_name)
    assert layout.nu == 12
    assert len(layout.sensor_name) == model.nsensor == 5
    assert set(layout.control_safe) == {layout.joint(name) for name in layout.dof_name if name}
    engine = mujoco_engine(compiled, STEPS, model.opt.timestep)
    without_contact(model)
    without_contact(engine.model)
    control = random_controls(compiled, STEPS)
    roll(engine, compiled, control)
    data = mujoco.MjData(model)
    data.qpos[:] = engine.initial[0, 1 : 1 + model.nq]
    expected = plain_rollout(model, data, control[:, 0])
    np.testing.assert_allclose(engine.state[0, :, 1 : 1 + model.nq], expected["qpos"], rtol=1e-6, atol=1e-6)


def test_what_was_taken_over_and_what_was_not_is_told():
    compiled = compiled_native(installed("newton", "examples/assets/nv_humanoid.xml"))
    assert any("21 actuators" in note and "31 sensors" in note for note in compiled.notes)
    assert "r: not taken over: sensor 'head_touch': there is no site 'head'" in compiled.notes
    assert not any("is not what the file says" in note for note in compiled.notes)


TWO_LINKS = """
<mujoco><worldbody>
  <body name="a" pos="0 0 1"><freejoint/><geom size=".1" contype="2" conaffinity="4"/><site name="s"/></body>
  <body name="b" pos=".05 0 1"><freejoint/><geom size=".1" contype="8" conaffinity="16"/></body>
  <body name="c" pos=".2 0 1"><freejoint/><geom size=".1" contype="4" conaffinity="0"/></body>
</worldbody><actuator><general name="push" site="s" gear="1 0 0 0 0 0" ctrlrange="-1 1"/></actuator></mujoco>
"""


@pytest.mark.parametrize(("keys", "own"), [({}, True), ({"self_collision": False}, False)])
@pytest.mark.parametrize("ground_contact", [True, False])
def test_the_scene_meets_every_geom_of_a_file_and_the_file_keeps_its_own_rule(tmp_path, keys, own, ground_contact):
    (tmp_path / "two.xml").write_text(TWO_LINKS)
    scene = native_scene(tmp_path / "two.xml", ground={}, ground_contact=ground_contact, **keys)
    box = {"name": "box", "shape": "box", "size": (0.2, 0.2, 0.2), "mass": 1.0, "position": (0.1, 0.0, 1.0)}
    wall = {"name": "wall", "shape": "box", "size": (0.2, 0.2, 0.2), "position": (0.0, 0.15, 1.0)}
    scene = type(scene).model_validate({**scene.model_dump(), "object": [box], "obstacle": [wall]})
    compiled = compile_scene(scene, cache=False)
    meets, model = colliding_pairs(compiled.spec().compile()), compiled.spec().compile()
    names = dict(zip([shape.name for shape in compiled.layout.shapes], compiled.geom_name, strict=True))
    a, b, c, box, wall, ground = (
        model.geom(names[n]).id for n in ("r/a_geom", "r/b_geom", "r/c_geom", "box", "wall", "ground")
    )
    assert not meets[a, b]
    assert meets[a, c] == own
    for link in (a, b, c):
        assert meets[link, [box, wall]].all()
        assert meets[link, ground] == ground_contact
    assert meets[box, wall]
    assert meets[box, ground]


# watched contacts: every root of a robot counts, in every engine


def test_the_force_on_a_robot_is_that_on_all_its_roots(tmp_path):
    """Three balls of one file on the ground: their weights together, however many trees the file has."""
    path = tmp_path / "three.xml"
    balls = "".join(
        f"<body name='ball{i}' pos='{i} 0 0.1'><freejoint/><geom size='.1' mass='{1 + i}'/><site name='s{i}'/></body>"
        for i in range(3)
    )
    actuator = "<general name='push' site='s0' gear='1 0 0 0 0 0' ctrlrange='-1 1'/>"
    path.write_text(f"<mujoco><worldbody>{balls}</worldbody><actuator>{actuator}</actuator></mujoco>")
    compiled = compiled_native(path, ground={})
    engine = mujoco_engine(compiled, 300, 0.005, pairs=(Pair("r", "ground"), Pair("ground", "r")))
    out = roll(engine, compiled, np.zeros((300, 1, 1), dtype=np.float32))
    np.testing.assert_allclose(out.contact_force.numpy()[-1, 0, :, 2], [6 * 9.81, -6 * 9.81], rtol=0.02)
    np.testing.assert_allclose(engine.pair_force(0)[-1, :, 2], [6 * 9.81, -6 * 9.81], rtol=0.02)
