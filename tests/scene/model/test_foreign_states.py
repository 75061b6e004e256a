# SPDX-License-Identifier: Apache-2.0
"""States travel to MuJoCo and Newton models of the user's own and back, by name."""

import mujoco
import numpy as np
import pytest
from small_scenes import BOX, CHAIN, chain_scene, compiled, make_scene, random_state

from warpmpc import MujocoStates, NewtonStates, State
from warpmpc.engine.newton import build_model

HOUSE = CHAIN.replace("</worldbody>", '<body name="door"><joint name="door"/><geom size=".1"/></body></worldbody>')


def test_a_users_mujoco_model_and_the_scene_agree_where_everything_is(tmp_path):
    scene = chain_scene(tmp_path)
    made = compiled(scene)
    model = mujoco.MjModel.from_xml_string(HOUSE)
    data = mujoco.MjData(model)
    states = MujocoStates(made, model)
    assert states.missing == ()

    q, qd = random_state(made.layout, 3)
    data.qpos[:] = data.qvel[:] = 0.0
    data.joint("door").qpos = 0.7
    states.write(State(q, qd, time=1.25), data)
    assert (data.joint("door").qpos, data.time) == (0.7, 1.25)  # what the scene does not know stays
    mujoco.mj_forward(model, data)

    # the scene's own model in the same state has its bodies in the same places, moving as fast
    own = made.spec().compile()
    other = mujoco.MjData(own)
    MujocoStates(made, own).write(State(q, qd), other)
    mujoco.mj_forward(own, other)
    for name in ("trunk", "head", "arm", "hand"):
        np.testing.assert_allclose(data.body(name).xpos, other.body(f"chain/{name}").xpos, atol=1e-6)
        np.testing.assert_allclose(data.body(name).cvel, other.body(f"chain/{name}").cvel, atol=1e-5)

    back = states.read(data)
    assert back.time == 1.25
    np.testing.assert_allclose(back.joint_qd, qd, atol=1e-5)
    for kind, start in zip(made.layout.joint_type, made.layout.joint_q_start, strict=True):
        if kind in (2, 4):  # q and -q are one orientation
            i = start + (3 if kind == 4 else 0)
            back.joint_q[i : i + 4] *= np.sign(back.joint_q[i : i + 4] @ q[i : i + 4])
    np.testing.assert_allclose(back.joint_q, q, atol=1e-6)


def test_what_the_users_model_lacks_comes_from_others_or_is_named():
    scene = make_scene(object=[BOX])
    robot = """<mujoco><worldbody><body name="disc">
      <joint name="x" type="slide" axis="1 0 0"/> <joint name="y" type="slide" axis="0 1 0"/> <joint name="yaw"/>
      <geom size=".1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(robot)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.1, 0.2, 0.3), (1.0, 2.0, 3.0)
    states = MujocoStates(compiled(scene), model)
    assert states.missing == ("box_free_joint",)
    with pytest.raises(ValueError, match="no joint box_free_joint"):
        states.read(data)
    seen = State.start(compiled(scene).layout)
    state = states.read(data, others=seen)
    np.testing.assert_allclose(state.joint_q[:3], (0.1, 0.2, 0.3))
    np.testing.assert_allclose(state.joint_qd[:3], (1.0, 2.0, 3.0))
    np.testing.assert_array_equal(state.joint_q[3:], seen.joint_q[3:])
    with pytest.raises(ValueError, match="none of the scene's joints: base/x"):
        MujocoStates(compiled(scene), mujoco.MjModel.from_xml_string("<mujoco/>"))


def test_mocap_bodies_and_activations_travel_too(tmp_path):
    text = """<mujoco><worldbody>
      <body name="hand" mocap="true"><geom size=".1"/></body>
      <body name="cart"><joint name="slide" type="slide" range="-1 1"/><geom size=".1"/></body></worldbody>
      <actuator><general name="motor" joint="slide" dyntype="filter" dynprm="0.1" ctrlrange="-1 1"/></actuator>
    </mujoco>"""
    (tmp_path / "cart.xml").write_text(text)
    scene = make_scene(
        robot=[{"name": "cart", "asset": str(tmp_path / "cart.xml")}],
        goal={"frame": "cart/cart", "position": (0.0, 0.0)},
        cost=[{"term": "control_effort"}],
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    states = MujocoStates(compiled(scene), model)
    data.act[:], data.mocap_pos[0], data.mocap_quat[0] = 0.4, (1.0, 2.0, 3.0), (0.6, 0.0, 0.8, 0.0)
    state = states.read(data)
    np.testing.assert_allclose(state.act, [0.4])
    np.testing.assert_allclose(state.mocap, [[1.0, 2.0, 3.0, 0.0, 0.8, 0.0, 0.6]])
    other = mujoco.MjData(model)
    states.write(state, other)
    np.testing.assert_allclose(other.act, data.act)
    np.testing.assert_allclose(other.mocap_pos, data.mocap_pos)
    np.testing.assert_allclose(other.mocap_quat, data.mocap_quat)


def test_a_newton_state_goes_there_and_back_in_the_world_that_is_meant():
    scene = make_scene(object=[BOX])
    made = compiled(scene)
    model = build_model(scene, 2, "cpu")
    q, qd = random_state(made.layout, 1)
    out = model.state()
    before = out.joint_q.numpy().copy()
    states = NewtonStates(made, model, world=1)
    assert states.missing == ()
    states.write(State(q, qd), out)
    np.testing.assert_array_equal(out.joint_q.numpy()[: made.layout.nq], before[: made.layout.nq])
    box = model.body_label.index("box", len(model.body_label) // 2)
    np.testing.assert_allclose(out.body_q.numpy()[box, :3], q[3:6], atol=1e-6)
    back = states.read(out, time=0.5)
    assert back.time == 0.5
    np.testing.assert_array_equal(back.joint_q, q)
    np.testing.assert_array_equal(back.joint_qd, qd)
