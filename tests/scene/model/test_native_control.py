# SPDX-License-Identifier: Apache-2.0
"""An MJCF robot on its own actuators from observation to command: terms read its sensors, plans its activations."""

import io

import numpy as np
import pytest
import warp as wp
from native_robots import CARTPOLE, QUADROTOR, native_scene

import warpmpc
from warpmpc import Controller, Plant, SceneError
from warpmpc.cli.describe import print_check
from warpmpc.loop.run.episode import Episode


@wp.struct
class TipParams:
    tip_sensor: int
    height: float


@warpmpc.cost_term("tip")
def tip(s: warpmpc.StepView, p: TipParams) -> float:
    """Squared distance of a sensed point from a height."""
    error = warpmpc.sensor(s, p.tip_sensor + 2) - p.height
    return error * error


def scene_of(folder, text, cost, **robot):
    path = folder / "robot.xml"
    path.write_text(text)
    scene = native_scene(path, **robot)
    planner = {"samples": 16, "horizon": 5}
    return type(scene).model_validate({**scene.model_dump(), "cost": cost, "planner": planner})


TIP = [{"term": "tip", "tip_sensor": "r/tip", "height": 2.0}]


def test_a_term_reads_a_sensor_by_name_and_the_plan_starts_from_the_plants_activations(tmp_path):
    scene = scene_of(tmp_path, CARTPOLE, TIP, keyframe="down")
    controller, plant = Controller(scene, terms=[tip], engine="mujoco"), Plant(scene)
    assert plant.layout.na == 1
    engine = controller.engine.simulator
    assert engine.model.nsensor == 1  # the other one is read by nobody
    assert engine.model.opt.timestep == pytest.approx(0.005)  # the file's, not two steps per control
    for _ in range(3):
        state = plant.observe()
        control = controller.step(state)
        assert np.isfinite(control).all()
        np.testing.assert_allclose(engine.trajectory.act.numpy()[0], np.tile(state.act, (16, 1)), atol=1e-6)
        found = engine.trajectory.sensor.numpy()
        assert found[..., 1:4].any()
        plant.apply(control)
    assert plant.state.act[0] != pytest.approx(0.3, abs=1e-4)  # the muscle moved on


def test_a_sensor_that_the_file_lacks_is_named_with_those_it_has(tmp_path):
    scene = scene_of(tmp_path, CARTPOLE, [{**TIP[0], "tip_sensor": "nose"}])
    with pytest.raises(SceneError, match=r"no such sensor.*nose.*r/tip"):
        Controller(scene, terms=[tip], engine="mujoco")


def test_a_mocap_body_moves_in_the_plant_and_plans_follow(tmp_path):
    cost = [{"term": "distance", "between": ["r/frame", "r/beacon"]}]
    scene = scene_of(tmp_path, QUADROTOR, cost, keyframe="hover")
    controller, plant = Controller(scene, engine="mujoco"), Plant(scene)
    pose = np.array([0.5, 0.5, 1.5, 0.0, 0.0, 0.0, 1.0], dtype=np.float32)
    plant.move_mocap("r/marker", pose)
    plant.apply(controller.step(plant.observe()))
    state = plant.observe()
    np.testing.assert_allclose(state.mocap, pose[None])
    controller.step(state)
    marker = plant.layout.mocap_body[0]
    np.testing.assert_allclose(controller.engine.simulator.trajectory.body_q.numpy()[-1, :, marker], [pose] * 16)
    np.testing.assert_allclose(plant.body_q[marker], pose, atol=1e-6)
    with pytest.raises(SceneError, match="no such mocap body"):
        plant.move_mocap("r/frame", pose)


def test_check_prints_what_was_taken_over(tmp_path):
    scene = scene_of(tmp_path, CARTPOLE, [{"term": "distance", "between": ["r/cart", "goal"]}])
    episode = Episode(scene, seed=0, engine="mujoco")
    episode.controller.step(episode.plant.observe())
    out = io.StringIO()
    print_check(episode, out)
    text = " ".join(out.getvalue().split())
    assert "2 bodies, 2 joints, 3 geoms, 2 sites, 3 actuators, 1 activation, 1 tendon, 2 sensors, 1 keyframe" in text


FLOATING = """<mujoco>
  <worldbody>
    <body name="hull" pos="0 0 1"><freejoint name="root"/><geom size=".1"/><site name="prop"/>
      <body name="eye" pos=".2 0 0"><joint name="gaze" type="ball"/><geom size=".05"/></body>
      <body name="arm" pos="-.2 0 0"><joint name="a" range="-90 90" axis="0 1 0"/><geom size=".05"/></body>
    </body>
  </worldbody>
  <tendon><fixed name="cord"><joint joint="a" coef="1"/></fixed></tendon>
  <actuator>
    <motor name="lift" site="prop" gear="0 0 1 0 0 0" ctrlrange="0 9"/>
    <position name="hold" joint="a" ctrlrange="-1 1"/>
    <velocity name="turn" joint="a" ctrlrange="-2 2"/>
    <motor name="pull" tendon="cord" ctrlrange="-3 3"/>
    <muscle name="flex" joint="a" ctrlrange="0 1"/>
    <adhesion name="grip" body="arm" ctrlrange="0 1"/>
  </actuator>
</mujoco>"""


def test_check_lists_joints_and_actuators_of_every_kind(tmp_path):
    scene = scene_of(tmp_path, FLOATING, [{"term": "distance", "between": ["r/hull", "goal"]}])
    episode = Episode(scene, seed=0, engine="mujoco")
    episode.controller.step(episode.plant.observe())
    out = io.StringIO()
    print_check(episode, out)
    rows = [" ".join(line.split()) for line in out.getvalue().splitlines()]
    for row in (
        "r/a -1.571 0 1.571 rad -90 0 90",
        "r/root 0, 0, 1 m free joint, z axis 0° from up",
        "r/gaze ball joint, turned by 0°",
        "r/lift motor at site r/prop 0 9 -",
        "r/hold position at joint r/a -1 1 -",
        "r/turn velocity at joint r/a -2 2 -",
        "r/pull motor at tendon r/cord -3 3 -",
        "r/flex muscle at joint r/a 0 1 -",
        "r/grip adhesion at body r/arm 0 1 -",
    ):
        assert row in rows
