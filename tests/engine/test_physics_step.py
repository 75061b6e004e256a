# SPDX-License-Identifier: Apache-2.0
"""The planner's physics step where a scene leaves it out: longer than the file's only where plans hardly change."""

import numpy as np
import pytest

from warpmpc import load_scene
from warpmpc.engine.protocol import TimeGrid
from warpmpc.engine.registry import _error, _Rollouts, physics_steps
from warpmpc.scene.model.compiled import compile_scene

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="%s"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" stiffness="%s" damping=".1" springref="1"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="hinge" joint="hinge" ctrlrange="-5 5"/></actuator>
</mujoco>
"""
SCENE = """
timing = { control_dt = 0.02, timeout = 2.0 }

[[robot]]
name = "arm"
asset = "arm.xml"

[[cost]]
term = "control_effort"

[planner]
horizon = 50
%s
"""


def chosen(folder, *, stiffness: float = 1.0, integrator: str = "implicitfast", more: str = "dt = 0.02"):
    """Physics steps of the engine ``mujoco``."""
    (folder / "arm.xml").write_text(ARM % (integrator, stiffness))
    (folder / "arm.toml").write_text(SCENE % more)
    scene = load_scene(str(folder / "arm.toml"))
    return physics_steps("mujoco", scene, compile_scene(scene), TimeGrid.of(scene))


def test_a_slow_arm_takes_longer_steps_than_its_file(tmp_path):
    steps = chosen(tmp_path)
    assert (steps.count[0], steps.length[0]) == (3, pytest.approx(0.02 / 3))
    assert chosen(tmp_path) == steps


def test_a_stiff_spring_keeps_the_step_of_its_file(tmp_path):
    assert chosen(tmp_path, stiffness=40000.0, integrator="Euler").length[0] == pytest.approx(0.002)


def test_what_a_scene_states_is_taken(tmp_path):
    assert chosen(tmp_path, more="[engine]\nsubsteps = 7").count[0] == 7


def test_steps_of_several_lengths_stay_multiples_of_the_physics_step(tmp_path):
    steps = chosen(tmp_path, more=f"dt = {[0.02] * 25 + [0.026] * 25}")
    assert (25 * steps.count[0] + 25 * steps.count[-1]) * steps.length[0] == pytest.approx(25 * 0.046)


@pytest.mark.parametrize("name", ["walker", "quadruped_walk", "humanoid_get_up", "pendulum", "quadrotor"])
def test_shipped_scenes_keep_the_steps_of_their_files(name):
    scene = load_scene(name)
    compiled, grid = compile_scene(scene), TimeGrid.of(scene)
    assert physics_steps("mujoco", scene, compiled, grid).count[0] == max(1, round(grid.dt[0] / compiled.timestep))


def test_the_error_is_a_share_of_the_spread_of_bodies_that_controls_move():
    exact = np.zeros((2, 2, 3, 3))
    exact[1, :, 0, 0] = -1.0, 1.0
    exact[1, :, 1, 0] = -0.01, 0.01
    ways = exact.copy()
    ways[1, :, 0] += 0.03
    ways[1, :, 1] += 5.0  # it hardly moves
    ways[1, :, 2] += 5.0  # nor does what falls by itself
    assert _error(ways, exact) == pytest.approx(0.03 * np.sqrt(3.0))
    ways[1, 0] = np.nan
    assert _error(ways, exact) == np.inf


def test_a_servo_is_tried_about_its_posture(tmp_path):
    (tmp_path / "arm.xml").write_text(
        (ARM % ("implicitfast", 1.0)).replace(
            '<motor name="hinge" joint="hinge" ctrlrange="-5 5"/>',
            '<position name="hinge" joint="hinge" kp="20" ctrlrange="-3 3"/>',
        )
    )
    start = 'name = "arm"\njoint_q = { hinge = 1.5 }'
    (tmp_path / "arm.toml").write_text(SCENE.replace('name = "arm"', start) % "dt = 0.02")
    scene = load_scene(str(tmp_path / "arm.toml"))
    tried = _Rollouts(scene, compile_scene(scene), TimeGrid.of(scene))._control
    np.testing.assert_allclose(np.median(tried[:, 0]), 1.5, atol=0.2)
