# SPDX-License-Identifier: Apache-2.0
"""Limits of controls that a scene leaves out come from its assets; where those say nothing, an error says so."""

import numpy as np
import pytest
from small_scenes import make_scene

from warpmpc import SceneError
from warpmpc.scene.model.compiled import compile_scene

URDF = """<robot name="cart">
  <link name="rail"/>
  <joint name="slide" type="prismatic">
    <parent link="rail"/> <child link="cart"/> <axis xyz="1 0 0"/>
    <limit lower="-1.5" upper="0.5" effort="40" velocity="3"/>
  </joint>
  <link name="cart"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="{turn}">
    <parent link="cart"/> <child link="top"/> <axis xyz="0 0 1"/>{limit}
  </joint>
  <link name="top"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""
LIMIT = '<limit lower="-2" upper="2" effort="5" velocity="7"/>'

MJCF = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="cart">
  <joint name="slide" type="slide" axis="1 0 0" range="-1 2"/><geom size="0.1" mass="1"/></body></worldbody>
  <actuator>{actuator}</actuator></mujoco>"""


def bounds(folder, drive: dict, *, turn="revolute", limit=LIMIT) -> tuple[np.ndarray, np.ndarray]:
    (folder / "cart.urdf").write_text(URDF.format(turn=turn, limit=limit))
    robot = {"name": "cart", "asset": str(folder / "cart.urdf"), "drive": drive}
    layout = compile_scene(_scene(robot), cache=False).layout
    return layout.control_lower, layout.control_upper


def _scene(robot: dict):
    return make_scene(robot=[robot], ground=None, goal={"frame": "cart/cart", "position": (0.0, 0.0)})


@pytest.mark.parametrize(
    ("drive", "lower", "upper"),
    [
        ({"mode": "velocity", "damping": 1.0}, [-3, -7], [3, 7]),
        ({"mode": "position", "stiffness": 1.0}, [-1.5, -2], [0.5, 2]),
        ({"mode": "effort"}, [-40, -5], [40, 5]),
        ({"mode": "effort", "effort_limit": [10.0, 2.0]}, [-10, -2], [10, 2]),
        (
            {
                "mode": "diff_drive",
                "joints": ["slide", "turn"],
                "damping": 1.0,
                "wheel_radius": 0.1,
                "track": 0.5,
            },
            [-0.3, -1.2],
            [0.3, 1.2],
        ),
    ],
    ids=["velocity", "position", "effort", "effort of the drive", "diff_drive"],
)
def test_a_drive_without_limits_takes_the_joints(tmp_path, drive, lower, upper):
    found = bounds(tmp_path, drive)
    np.testing.assert_allclose(found, (lower, upper), rtol=1e-6)


def test_what_the_asset_does_not_say_is_asked_for(tmp_path):
    message = r"robot\.cart\.drive\.limit: the asset says no range of joint 'turn': give limit"
    with pytest.raises(SceneError, match=message):
        bounds(tmp_path, {"mode": "position", "stiffness": 1.0}, turn="continuous", limit="")


@pytest.mark.parametrize(
    ("actuator", "limits"),
    [
        ('<position joint="slide" kp="5"/>', (-1.0, 2.0)),
        ('<motor joint="slide" forcerange="-8 4"/>', (-8.0, 4.0)),
        ('<motor joint="slide" forcerange="-8 4" ctrlrange="-1 1"/>', (-1.0, 1.0)),
        ('<motor joint="slide"/>', None),
        ('<velocity joint="slide" kv="2" forcerange="-1 1"/>', None),
    ],
    ids=["position", "force", "control", "nothing", "velocity"],
)
def test_an_actuator_without_a_range_takes_its_joints_or_its_force(tmp_path, actuator, limits):
    (tmp_path / "cart.xml").write_text(MJCF.format(actuator=actuator))
    scene = _scene({"name": "cart", "asset": str(tmp_path / "cart.xml")})
    if limits is None:
        with pytest.raises(SceneError, match="has no limits to choose controls in"):
            compile_scene(scene, cache=False)
        return
    layout = compile_scene(scene, cache=False).layout
    assert (layout.control_lower[0], layout.control_upper[0]) == limits
