# SPDX-License-Identifier: Apache-2.0
"""How a plant moves tells why a run failed: falls, a standstill; none where all is well."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from small_scenes import make_scene

from warpmpc import Plant
from warpmpc.extras.doctor.signs import PlantSigns
from warpmpc.scene.model.compiled import compile_scene

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
        signs.note(SimpleNamespace(terms=dict(terms)))
        plant.apply(np.array(control))
    return list(map(str, signs.signs(unmet=unmet)))


def test_a_tall_robot_that_tips_over_fell_and_nothing_else_is_said(tmp_path):
    robot = {"position": (0.0, 0.0, 0.5), "rotation": (0.0, 0.15, 0.0, 0.989)}
    (sign,) = signs_of(tmp_path, root="<freejoint/>", control=(0.6, 0.0), time=3.0, **robot)
    assert sign.startswith("r fell at ")
    assert "tilted by" in sign
    assert "orientation with tilt" in sign


DRONE = """
<mujoco><worldbody>
  <body name="frame" pos="0 0 .05"><freejoint/><geom type="box" size=".15 .15 .03" mass=".5"/>
    <site name="a" pos="0 .12 0"/><site name="b" pos="0 -.12 0"/></body>
</worldbody><actuator>
  <motor name="a" site="a" gear="0 0 1" ctrlrange="0 6"/><motor name="b" site="b" gear="0 0 1" ctrlrange="0 6"/>
</actuator></mujoco>
"""


def test_a_drone_that_turned_over_on_the_floor_is_told_with_the_time_since_when_it_lies_there(tmp_path):
    (sign,) = signs_of(tmp_path, asset=DRONE, frame="r/frame", control=(3.5, 0.0), time=4.0)
    found = re.fullmatch(
        r"r fell at (.*?) s, at up to (.*?) m/s; it is tilted by (.*?)° .* still since (.*?) s on (.*?): .*", sign
    )
    fell, speed, tilt, since = map(float, found.groups()[:4])
    assert 0.2 < fell <= since < 2.0
    assert speed > 0.5
    assert tilt > 90.0
    assert found[5] == "ground"


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
    assert sign.startswith("all stands still since 0.00 s, the last 4.0 s; ")
    assert says in sign
    assert signs_of(tmp_path, root="", control=(0.0, 0.0), time=4.0, terms=terms, unmet=False) == []
