# SPDX-License-Identifier: Apache-2.0
"""Noise that turns a robot over is told with a σ that does not, where nothing holds what turns."""

import numpy as np
import pytest
from needs import need_scene

from warpmpc import Controller, State, load_scene
from warpmpc.extras.doctor.examine import tumble_findings
from warpmpc.loop.run.result import Changes
from warpmpc.planner.tumbles import KNOTS, OVER, Tumble
from warpmpc.planner.tumbles import tumble as tumble_of

DRONE = """
<mujoco>
  <worldbody>
    <body name="hull" pos="0 0 1">
      <freejoint/>
      <geom type="box" size=".12 .12 .02" mass=".5"/>
      <site name="left" pos="0 .1 0"/>
      <site name="right" pos="0 -.1 0"/>
      <body name="load" pos="0 0 -.02">
        <joint name="cable" type="ball"/>
        <geom type="sphere" size=".03" pos="0 0 -.4" mass=".1" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="left" site="left" ctrlrange="0 8" gear="0 0 1 0 0 0"/>
    <motor name="right" site="right" ctrlrange="0 8" gear="0 0 1 0 0 0"/>
    <motor name="spin" site="left" ctrlrange="-.001 .001" gear="0 0 0 0 0 1"/>
  </actuator>
</mujoco>
"""
SCENE = """
timing = { control_dt = 0.02 }
planner = { samples = 8, lookahead = 0.8, knots = 5, refine = false, noise.sigma.range = 0.25 }
engine = { name = "mujoco", threads = 1 }
goal = { frame = "drone/hull", position = [1.0, 0.0, 1.0] }

[[robot]]
name = "drone"
asset = "drone.xml"

[[cost]]
term = "distance"
between = ["drone/hull", "goal"]
"""


def made(folder, *overrides: str, asset: str = DRONE) -> Controller:
    """Controller of the drone."""
    (folder / "drone.xml").write_text(asset)
    (folder / "scene.toml").write_text(SCENE)
    return Controller(load_scene(folder / "scene.toml", overrides=overrides), device="cpu")


def tumble(controller: Controller) -> Tumble | None:
    """What the noise of a controller's samples turns over."""
    return tumble_of(controller.scene, controller.compiled, controller.engine.name)


def test_noise_that_turns_a_drone_over_is_told_and_what_does_not_turn_it_keeps_its_own(tmp_path):
    controller = made(tmp_path)
    found = tumble(controller)
    arm, inertia, share = 0.1, 0.5 * (0.24**2 + 0.04**2) / 12, 0.25 * 8.0
    free = np.sqrt(2.0 * OVER * inertia / (np.sqrt(2.0) * arm * share))  # of two motors' noise, without the load
    assert found.body == "drone/hull"
    assert found.time == pytest.approx(free, rel=0.3)
    assert found.knots == pytest.approx(0.2)
    assert found.factor[2] == 1.0
    assert found.factor[0] == found.factor[1] < 0.5
    (finding,) = tumble_findings(controller)
    for part in ("samples turn drone/hull over", "drone/left, drone/right", "0.2 s", "planner.noise.sigma.range = ["):
        assert part in str(finding)
    key, value = finding.cure.removeprefix("try ").removesuffix(", with which they do not").split(" = ")
    assert tumble(made(tmp_path, f"{key}={value}")) is None


def test_knots_that_come_in_time_and_what_is_held_are_not_told(tmp_path):
    assert tumble(made(tmp_path, "planner.knots=40")) is None
    assert tumble(made(tmp_path, asset=DRONE.replace("<freejoint/>", '<joint type="slide" axis="0 0 1"/>'))) is None
    led = '<equality><weld body1="load" active="true"/></equality>\n  <actuator>'
    assert tumble(made(tmp_path, asset=DRONE.replace("<actuator>", led))) is None


def test_steps_that_are_not_mujocos_are_left_alone(tmp_path):
    controller = made(tmp_path)
    for solver, found in (("mujoco", True), ("xpbd", False)):
        scene = load_scene(tmp_path / "scene.toml", overrides=["engine.name=newton", f"engine.solver={solver}"])
        assert (tumble_of(scene, controller.compiled, "newton") is not None) == found


@pytest.mark.parametrize("name", ["panda_reach", "omni_push_box", "go2_walk", "humanoid_get_up", "quadrotor"])
def test_scenes_that_are_calm_say_nothing(name):
    need_scene(name)
    assert tumble(Controller(load_scene(name), device="cpu", engine="mujoco")) is None


def test_a_quadrotor_with_the_noise_of_the_defaults_is_told():
    controller = Controller(load_scene("quadrotor", overrides=["planner.noise.sigma=1.0", "planner.knots=5"]))
    assert "planner.noise.sigma = 0." in next(tumble_findings(controller)).cure


def test_default_noise_is_lowered_to_what_turns_nothing_over(tmp_path):
    given = made(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE.replace(", noise.sigma.range = 0.25", ""))
    controller = Controller(load_scene(tmp_path / "scene.toml"), device="cpu")
    assert controller.lowered is not None
    assert tumble(controller) is None
    share = np.array(controller.scene.planner.noise.sigma.range)
    assert np.all(share[:2] < 0.125)
    assert share[2] == 0.25
    state = State(controller.layout.joint_q, controller.layout.joint_qd, 0.0)
    spread = []
    for one in (given, controller):
        one.plan(state)
        spread.append(np.std([one.rollout(i).knots for i in range(2, 8)], axis=(0, 1)))
    assert np.all(spread[1][:2] < 0.5 * spread[0][:2])
    assert spread[1][2] == pytest.approx(spread[0][2], rel=0.01)
    (finding,) = tumble_findings(controller)
    assert finding.cure.startswith("plans take planner.knots = 5 and planner.noise.sigma.range = [")


def test_default_knots_come_closer_so_that_noise_is_lowered_less(tmp_path):
    shares = []
    for knots in ("knots = 5", "lookahead = 0.8"):
        (tmp_path / "drone.xml").write_text(DRONE)
        text = SCENE.replace(", noise.sigma.range = 0.25", "").replace("lookahead = 0.8, knots = 5", knots)
        (tmp_path / "scene.toml").write_text(text)
        controller = Controller(load_scene(tmp_path / "scene.toml"), device="cpu")
        assert tumble(controller) is None
        shares.append(controller.scene.planner.noise.sigma.range[0])
    assert controller.scene.planner.knots == KNOTS
    assert f"planner.knots = {KNOTS} and" in next(tumble_findings(controller)).cure
    assert shares[1] > 1.5 * shares[0]
    half = [f"{key}={value}" for key, value in Changes(controller).sigma(0.5).items()]
    tried = Controller(load_scene(tmp_path / "scene.toml", overrides=half), device="cpu").scene.planner
    assert tried.knots == KNOTS
    assert tried.noise.sigma.range[0] == pytest.approx(0.5 * shares[1], rel=0.01)
