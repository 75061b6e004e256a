# SPDX-License-Identifier: Apache-2.0
"""Gravity of a scene: in the rollouts of every engine, in the plant, in what holds a start and in what is estimated."""

import numpy as np
import pytest
from small_scenes import DISC, compiled, make_scene

from warpmpc import Controller, Plant
from warpmpc.loop.estimation.base_filter import BaseFilter
from warpmpc.loop.run.episode import draws_bodies
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.schema_estimate import EstimateBase

MOON = (0.0, 0.4, -1.62)
BALL = {"name": "ball", "shape": "sphere", "size": 0.1, "mass": 1.0, "position": (3.0, 0.0, 4.0)}
LIFT = """
<mujoco><option gravity="0 0 0">{flag}</option><worldbody><body name="car" pos="0 0 1">
  <joint name="lift" type="slide" axis="0 0 1" range="-2 2" limited="true"/><geom type="sphere" size=".1" mass="2"/>
</body></worldbody><actuator><motor name="lift" joint="lift" ctrlrange="-50 50"/></actuator></mujoco>
"""


def falling(solver="mujoco", **engine):
    """A ball in the air beside a disc that drives."""
    return make_scene(
        robot=[{**DISC, "drive": {**DISC["drive"], "damping": 2.0}}],
        object=[BALL],
        ground=None,
        engine={"substeps": 16, "solver": solver, **engine},
        planner={"samples": 4, "horizon": 5, "noise": {"sigma": (0.1,)}},
    )


def lift(folder, flag="", **engine):
    """A scene of a weight on a slide, by a file that says that there is no gravity."""
    (folder / "lift.xml").write_text(LIFT.format(flag=flag))
    robot = {"name": "lift", "asset": str(folder / "lift.xml")}
    return make_scene(robot=[robot], ground=None, goal={"frame": "lift/car", "position": (0.0, 0.0)}, engine=engine)


@pytest.mark.parametrize("gravity", [None, MOON])
@pytest.mark.parametrize(
    ("engine", "solver"),
    [("mujoco", "mujoco"), ("fused", "mujoco"), ("mujoco_warp", "mujoco"), ("newton", "mujoco"), ("newton", "xpbd")],
)
def test_things_fall_as_the_scene_says_in_rollouts(engine, solver, gravity):
    scene = falling(solver, gravity=gravity)
    controller = Controller(scene, engine=engine, device="cpu", compiled=compiled(scene))
    controller.step(Plant(scene, compiled=compiled(scene)).observe())
    ball, ahead = controller.rollout(0).frame("ball")[:, :3], 5 * scene.timing.control_dt
    way = 0.5 * np.array(gravity or (0.0, 0.0, -9.81)) * ahead**2
    np.testing.assert_allclose(ball[-1] - ball[0], way, rtol=0.05, atol=1e-4)  # a sum of steps


def test_things_fall_as_the_scene_says_in_the_plant():
    plant = Plant(falling(gravity=MOON))
    start = plant.state.joint_q[-7:-4].copy()
    for _ in range(10):
        plant.apply(np.zeros(3))
    np.testing.assert_allclose(plant.state.joint_q[-7:-4] - start, 0.5 * np.array(MOON) * plant.time**2, rtol=0.05)


@pytest.mark.parametrize("flag", ["", '<flag gravity="disable"/>'])
def test_a_file_without_gravity_gets_the_scenes(tmp_path, flag):
    assert compile_scene(lift(tmp_path, flag)).layout.gravity == (0.0, 0.0, 0.0)
    for g in (1.62, 9.81):  # what is compiled is kept for each
        found = compile_scene(lift(tmp_path, flag, gravity=(0.0, 0.0, -g)))
        assert found.layout.control_start == pytest.approx([2.0 * g])  # what holds it


def test_episodes_may_differ_in_gravity():
    draw = {"draw": {"engine.gravity": {"low": (0.0, 0.0, -9.0), "high": (0.0, 0.0, -1.0)}}}
    assert draws_bodies(falling(gravity=MOON).model_copy(update={"randomize_task": _section(draw)}))


def _section(draw):
    return make_scene(engine={"gravity": MOON}, randomize_task=draw).randomize_task


def test_a_base_at_rest_is_estimated_at_rest_in_the_scenes_gravity():
    filter = BaseFilter(EstimateBase(feet=["a"]), 1, MOON)
    state = filter.start(0.0, np.eye(3), np.zeros(3))
    for k in range(1, 101):
        state = filter.propagate(state, 0.01 * k, np.zeros(3), -np.array(MOON))
    np.testing.assert_allclose(state.velocity, 0.0, atol=1e-9)
