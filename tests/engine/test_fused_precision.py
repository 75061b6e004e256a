# SPDX-License-Identifier: Apache-2.0
"""Infinite limits are none, and numbers that single precision does not hold are refused before anything is compiled."""

import mujoco
import numpy as np
import pytest
from shared.plain_rollout import PlainRollout
from small_scenes import BOX, DISC, make_scene

from warpmpc import Controller, SceneError
from warpmpc.physics.runtime.bake import OutOfRange, literal

LIMITS = """
<mujoco><compiler autolimits="true" angle="radian"/><option timestep="0.004" integrator="implicitfast"/><worldbody>
  <body pos="0 0 1"><joint name="both" type="slide" axis="1 0 0" range="-inf inf" actuatorfrcrange="-inf inf"/>
    <geom size=".1" mass="1"/></body>
  <body pos="0 1 1"><joint name="low" type="slide" axis="1 0 0" range="-0.02 {far}"/><geom size=".1" mass="1"/></body>
  <body pos="0 2 1"><joint name="high" axis="0 1 0" range="-{far} 0.02"/><geom size=".1" mass="1" pos=".1 0 0"/></body>
  <body pos="0 3 1"><joint type="ball" range="0 {far}"/><geom size=".1" mass="1" pos=".1 0 0"/></body>
</worldbody>
<tendon><fixed name="pull" range="-inf {far}"><joint joint="both" coef="1"/></fixed>
  <fixed name="rope" range="-{far} 0.03" stiffness="20" springlength="0.01 {far}"><joint joint="low" coef="1"/></fixed>
</tendon>
<actuator><motor joint="both" ctrlrange="-inf inf" forcerange="-2 {far}"/>
  <position joint="low" kp="50" kv="1" ctrlrange="-{far} 1" forcerange="-inf inf"/>
  <motor tendon="pull" ctrlrange="-1 1" forcerange="-{far} {far}"/></actuator></mujoco>"""


@pytest.mark.parametrize("far", ["inf", "1e39"])
def test_infinite_limits_are_those_of_mujoco(far):
    mj = mujoco.MjModel.from_xml_string(LIMITS.format(far=far))
    worlds, steps = 16, 60
    rng = np.random.default_rng(0)
    q, v = np.tile(mj.qpos0, (worlds, 1)), rng.normal(size=(worlds, mj.nv))
    control = 3.0 * rng.normal(size=(steps, worlds, mj.nu))
    found, _ = PlainRollout(mj, worlds, steps)(q, v, control)
    data, expected = mujoco.MjData(mj), np.empty((steps, worlds, mj.nq))
    for w in range(worlds):
        mujoco.mj_resetData(mj, data)
        data.qpos[:], data.qvel[:] = q[w], v[w]
        for t in range(steps):
            data.ctrl[:] = control[t, w]
            mujoco.mj_step(mj, data)
            expected[t, w] = data.qpos
    assert expected[:, :, 1].min() < -0.015  # the finite limits were met
    assert expected[:, :, 2].max() > 0.015
    np.testing.assert_allclose(found, expected, atol=1e-4)


def joint(name: str, value: str) -> dict:
    """A robot whose joint says something."""
    text = f'<mujoco><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0" {name}="{value}"/>'
    return (
        text + '<geom size=".1"/></body></worldbody><actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>'
    )


@pytest.mark.parametrize(
    ("name", "words"),
    [("damping", "damping"), ("stiffness", "stiffness"), ("armature", "armature"), ("frictionloss", "dry friction")],
)
def test_a_number_of_a_robots_file_without_room_is_named(name, words, tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(joint(name, "1e39"))
    robot = {"name": "cart", "asset": str(path)}
    cost, goal = {"term": "distance", "between": ["cart/cart", "goal"]}, {"frame": "cart/cart", "position": (0.0, 0.0)}
    scene = make_scene(robot=[robot], ground=None, goal=goal, cost=[cost], planner={"samples": 4, "horizon": 2})
    with pytest.raises(SceneError, match=rf"'cart' has 1e\+39 as its {words}: lower it") as caught:
        Controller(scene, engine="fused", device="cpu")
    assert caught.value.key == "robot.cart"


def test_a_mass_whose_products_have_no_room_is_named_and_auto_takes_double_precision():
    scene = make_scene(object=[{**BOX, "mass": 1e30}], planner={"samples": 4, "horizon": 2})
    with pytest.raises(
        SceneError, match=r"'box' has 1e\+30 as its mass: lower it, or take the engine mujoco"
    ) as caught:
        Controller(scene, engine="fused", device="cpu")
    assert caught.value.key == "object.box"
    assert Controller(scene, device="cpu").engine.name == "mujoco"


@pytest.mark.parametrize("key", ["effort_limit", "damping", "limit"])
def test_a_scene_says_no_number_beyond_single_precision(key):
    with pytest.raises(ValueError, match=rf"(?s)drive.*{key}.*must fit into single precision: at most 1e\+30"):
        make_scene(robot=[{**DISC, "drive": {**DISC["drive"], key: 1e39}}])


@pytest.mark.parametrize("x", [np.inf, -np.inf, np.nan, 1e39, -3.5e38])
def test_what_is_no_number_in_c_is_never_written(x):
    with pytest.raises(OutOfRange, match="does not fit into single precision"):
        literal(x)
