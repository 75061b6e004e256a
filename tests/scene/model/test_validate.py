# SPDX-License-Identifier: Apache-2.0
"""Assets that can be read but not planned with are refused by the joint that is wrong."""

from dataclasses import replace

import pytest
from small_scenes import CHAIN, compiled, make_scene

from warpmpc import SceneError
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.overlaps import validate_layout

KEY = '<keyframe><key name="start" qpos="{}"/></keyframe></mujoco>'
ARM = """<robot name="arm"><link name="base"/>
  <joint name="turn" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="{axis}"/>
    <limit lower="{lower}" upper="2" effort="5" velocity="7"/></joint>
  <link name="tip"><inertial><origin xyz="{com} 0 0"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def build(asset, **robot) -> None:
    drive = {"mode": "velocity", "damping": 1.0, "limit": 1.0}
    robot = {"name": "arm", "asset": str(asset), "drive": drive, **robot}
    compile_scene(
        make_scene(robot=[robot], ground=None, goal={"frame": "arm/tip", "position": (0.0, 0.0)}), cache=False
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"axis": "0 0 nan"}, "no physics can be made of this: .*axis too small.*'arm_turn'"),
        ({"lower": "3"}, "joint 'turn': lower must be below upper"),
        ({"com": "inf"}, "the centre of mass of 'arm/tip' is not finite"),
    ],
    ids=["axis", "limits", "centre"],
)
def test_a_urdf_that_makes_no_sense_is_refused(tmp_path, change, says):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.format(**{"axis": "0 0 1", "lower": "-2", "com": "0.1", **change}))
    with pytest.raises(SceneError, match=rf"robot\.arm\.asset: .*({says})"):
        build(path)


def test_limits_the_wrong_way_round_are_refused_whatever_the_asset_is():
    scene = make_scene()
    layout = compiled(scene).layout
    validate_layout(layout, scene)
    with pytest.raises(
        SceneError, match=r"robot\.base\.asset: the lower limit of joint 'base/.*' is above its upper one"
    ):
        validate_layout(replace(layout, dof_lower=layout.dof_upper + 1.0), scene)


def test_a_keyframe_of_what_is_no_number_is_refused(tmp_path):
    path = tmp_path / "chain.xml"
    path.write_text(CHAIN.replace("</mujoco>", KEY.format("0 0 1 1 0 0 0 1 0 0 0 0 0 0 -inf 0 0")))
    with pytest.raises(SceneError, match=r"robot\.arm\.asset: the start of joint 'arm/.*' is not finite"):
        build(path, keyframe="start", floating=True)
