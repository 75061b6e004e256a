# SPDX-License-Identifier: Apache-2.0
"""An axis of a frame is held up, in a scene that has neither goal nor targets."""

import numpy as np
import pytest

import warpmpc
from warpmpc.loop.run.episode import Episode

POLE = """<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody><body name="pole" pos="0 0 1"><joint name="swing" axis="0 1 0" damping="0.3"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.3"/>
    <site name="tip" pos="0.3 0 0"/></body></worldbody>
  <actuator><motor name="swing" joint="swing" gear="3" ctrlrange="-1 1"/></actuator>
</mujoco>"""
SCENE = """
ground = false
timing = { control_dt = 0.02, timeout = 3.0 }
robot = [{ name = "arm", asset = "pole.xml" }]
cost = [
    { name = "up", term = "orientation", of = "arm/tip", axis = [1.0, 0.0, 0.0] },
    { term = "joint_velocity", weight = 0.01 },
]
planner = { samples = 64, lookahead = 0.4, dt = 0.02 }
success = { conditions = { term = "up", below = 0.1 }, hold = 0.3 }
"""


@pytest.mark.parametrize("engine", ["fused", "mujoco"])
def test_a_pole_is_raised_until_its_axis_points_up(tmp_path, engine):
    (tmp_path / "pole.xml").write_text(POLE)
    (tmp_path / "scene.toml").write_text(SCENE)
    scene = warpmpc.load_scene(tmp_path / "scene.toml", overrides=["engine.threads=1"])
    episode = Episode(scene, seed=0, engine=engine)
    result = episode.run()
    assert result.success, result
    assert result.engine == engine
    angle = episode.plant.state.joint_q[0]  # of the pole about y, from lying along x
    assert abs(angle + 0.5 * np.pi) < 0.1
