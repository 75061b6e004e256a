# SPDX-License-Identifier: Apache-2.0
"""How a plant moves tells why a run failed: falls, a standstill, stops, links that touch; none where all is well."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from small_scenes import make_scene

from warpmpc.model.compiled import compile_scene
from warpmpc.plant.plant import Plant
from warpmpc.run.plant_signs import PlantSigns, fingers

BASE = """
<mujoco><compiler angle="radian"/><worldbody>
  <body name="torso" pos="0 0 .5">
    {root}
    <geom type="box" size=".05 .05 .4" mass="5" contype="1" conaffinity="1"/>
    <body name="upper" pos="0 .06 .3"><joint name="turn" axis="0 0 1" range="-.6 .6" damping=".5" armature=".01"/>
      <geom type="capsule" fromto="0 0 0 0 .3 0" size=".02" mass=".1" contype="0" conaffinity="0"/>
      <body name="fore" pos="0 .3 0"><joint name="bend" axis="0 0 1" range="-3 3" damping=".5" armature=".01"/>
        <geom type="capsule" fromto="0 .01 0 0 .3 0" size=".02" mass=".1" contype="2" conaffinity="2"/></body>
    </body>
    <body name="guard" pos="-.1 .16 .3">
      <geom type="box" size=".08 .04 .02" mass=".1" contype="2" conaffinity="2"/></body>
  </body>
</worldbody><actuator>
  <position name="turn" joint="turn" kp="20" ctrlrange="-.6 .6"/>
  <motor name="bend" joint="bend" ctrlrange="-3 3"/>
</actuator></mujoco>
"""


def signs_of(
    tmp_path, *, control, time, root="", asset=BASE, terms=(("a", 1.0),), unmet=True, frame="r/fore", **robot
) -> list[str]:
    """Signs of a plant that is sent one control all the time."""
    (tmp_path / "r.xml").write_text(asset.format(root=root))
    scene = make_scene(
        timing={"control_dt": 0.02, "timeout": 60.0},
        robot=[{"name": "r", "asset": str(tmp_path / "r.xml"), **robot}],
        goal={"frame": frame, "position": (5.0, 0.0, 0.0)},
        cost=[{"term": "distance", "between": [frame, "goal"]}],
    )
    plant = Plant(scene, compiled=compile_scene(scene, cache=False))
    signs = PlantSigns(SimpleNamespace(costs=SimpleNamespace(labels=[name for name, _ in terms])), plant)
    for _ in range(round(time / 0.02)):
        signs.note(SimpleNamespace(terms=dict(terms)), np.array(control))
        plant.apply(np.array(control))
    return list(signs.signs(unmet=unmet))


def test_a_tall_robot_that_tips_over_fell_and_nothing_else_is_said(tmp_path):
    robot = {"position": (0.0, 0.0, 0.5), "rotation": (0.0, 0.15, 0.0, 0.989)}
    (sign,) = signs_of(tmp_path, root="<freejoint/>", control=(0.6, 0.0), time=3.0, **robot)
    assert sign.startswith("r fell at ")
    assert "tilted by" in sign
    assert "orientation with tilt" in sign


def test_a_robot_that_stands_has_not_fallen(tmp_path):
    assert not [s for s in signs_of(tmp_path, root="<freejoint/>", control=(0.0, 0.0), time=1.0) if "fell" in s]


@pytest.mark.parametrize(
    ("terms", "says"),
    [
        ((("near", 3.0), ("far", 1.0), ("none", 0.0)), "costs balance there (near 75%, far 25%): raise the weight"),
        ((("near", 3.0), ("none", 0.0)), "near 100% of the cost is left and no sample finds less: raise"),
    ],
)
def test_a_standstill_is_told_with_the_shares_of_the_costs(tmp_path, terms, says):
    (sign,) = signs_of(tmp_path, root="", control=(0.0, 0.0), time=4.0, terms=terms)
    assert sign.startswith("all stands still for the last 1.3 s: ")
    assert says in sign
    assert signs_of(tmp_path, root="", control=(0.0, 0.0), time=4.0, terms=terms, unmet=False) == []


def test_a_servo_that_is_sent_to_its_lock_is_no_sign_and_a_motor_that_pushes_to_a_stop_is(tmp_path):
    assert not [s for s in signs_of(tmp_path, root="", control=(0.6, 0.0), time=2.0) if "end of its range" in s]
    pushed = signs_of(tmp_path, root="", control=(0.0, -3.0), time=3.0, unmet=False)
    assert [s for s in pushed if s.startswith("joint r/bend is at an end of its range")]


GRIPPER = """
<mujoco><worldbody>
  <body name="arm" pos="0 0 1"><joint name="lift" type="slide" axis="0 0 1" range="-.5 .5" damping="30"/>
    <geom type="box" size=".05 .05 .05" mass="1" contype="0" conaffinity="0"/>
    <body name="left" pos="0 .05 0"><joint name="left" type="slide" axis="0 1 0" range="-.04 .04" damping="5"/>
      <geom type="box" size=".01 .01 .05" mass=".1" contype="0" conaffinity="0"/></body>
    <body name="right" pos="0 -.05 0"><joint name="right" type="slide" axis="0 1 0" range="-.04 .04" damping="5"/>
      <geom type="box" size=".01 .01 .05" mass=".1" contype="0" conaffinity="0"/></body>
  </body>
  <body name="drawer" pos="1 0 1"><joint name="drawer" type="slide" axis="0 0 1" range="-.1 .1" damping="1"/>
    <geom type="box" size=".1 .1 .1" mass="1"/></body>
</worldbody><actuator>
  <motor joint="lift" ctrlrange="-40 40"/><motor joint="left" ctrlrange="-9 9"/><motor joint="right" ctrlrange="-9 9"/>
</actuator></mujoco>
"""


def test_closed_fingers_and_what_nothing_drives_are_no_joints_at_their_stops(tmp_path):
    signs = signs_of(tmp_path, asset=GRIPPER, frame="r/arm", control=(-40.0, -9.0, 9.0), time=2.0)
    (stop,) = [sign for sign in signs if "end of its range" in sign]
    assert stop.startswith("joint r/lift is at an end of its range")


FINGERS = """
<mujoco><worldbody>
  <body name="palm" pos="0 0 1"><joint name="wrist" type="slide" axis="0 0 1"/><geom size=".01"/>
    <body name="a"><joint name="a"/><geom size=".01"/><body name="a2"><joint name="a2"/><geom size=".01"/></body></body>
    <body name="b"><joint name="b"/><geom size=".01"/><body name="b2"><joint name="b2"/><geom size=".01"/></body></body>
  </body>
</worldbody></mujoco>
"""


def test_fingers_are_the_chains_that_begin_on_one_link():
    model = mujoco.MjModel.from_xml_string(FINGERS)
    palm, a, a2, b, b2 = range(1, 6)
    assert fingers(model, range(1, 6)) == {a: a, a2: a, b: b, b2: b}
    assert palm not in fingers(model, range(1, 6))


def test_links_of_one_robot_that_touch_are_named(tmp_path):
    signs = signs_of(tmp_path, root="", control=(0.0, 3.0), time=3.0, unmet=False, self_collision=True)
    assert [s for s in signs if s.startswith("links r/fore and r/guard touch each other")], signs
