# SPDX-License-Identifier: Apache-2.0
"""A hand that pulls and turns bodies of plants, as the mouse does in MuJoCo's viewer."""

import numpy as np
import pytest
from small_scenes import make_scene

from warpmpc import Plant, SceneError

BALL = {"name": "ball", "shape": "box", "size": (0.1, 0.1, 0.1), "mass": 2.0, "position": (0.0, 2.0, 0.05)}
REST = np.zeros(3)


def ball_scene(**sections):
    return make_scene(**{"object": [BALL], "ground": {}, "plant": {"randomize": False}, **sections})


def at(plant, name):
    return plant.body_q[plant.layout.body_name.index(name)]


def hold(plant, seconds):
    for _ in range(round(seconds / plant.scene.timing.control_dt)):
        plant.apply(REST)


@pytest.mark.parametrize("control_dt", [0.04, 0.1])
def test_what_is_held_goes_where_the_hand_goes_and_does_not_swing(control_dt):
    load = {**BALL, "friction": 0.01}
    plant = Plant(ball_scene(object=[load], timing={"control_dt": control_dt, "timeout": 20.0}))
    plant.perturbation.grab("ball", at(plant, "ball")[:3])
    plant.perturbation.pull((0.5, 2.0, 0.8))
    hold(plant, 4.0)
    settled = at(plant, "ball")[:3].copy()
    np.testing.assert_allclose(settled[:2], (0.5, 2.0), atol=0.02)
    assert 0.15 < settled[2] < 0.75, "it hangs from the spring"
    hold(plant, 0.4)
    np.testing.assert_allclose(at(plant, "ball")[:3], settled, atol=0.02)


def test_a_pull_is_as_strong_as_its_load_is_heavy():
    ways = []
    for mass in (0.5, 50.0):
        plant = Plant(ball_scene(object=[{**BALL, "mass": mass, "friction": 0.01}]))
        plant.perturbation.grab("ball", at(plant, "ball")[:3])
        plant.perturbation.pull((0.3, 2.0, 0.05))
        hold(plant, 0.2)
        ways.append(at(plant, "ball")[0])
    assert ways[0] == pytest.approx(ways[1], rel=0.05)
    assert ways[0] > 0.02


def test_a_moment_turns_without_carrying_away():
    plant = Plant(ball_scene(object=[{**BALL, "friction": 0.01}]))
    plant.perturbation.grab("ball", at(plant, "ball")[:3])
    plant.perturbation.turn((0.0, 0.0, 1.0))
    hold(plant, 2.0)
    x, y, _, _, _, z, w = at(plant, "ball")
    assert 2.0 * np.arctan2(z, w) == pytest.approx(1.0, abs=0.2)
    np.testing.assert_allclose((x, y), (0.0, 2.0), atol=0.02)


def test_a_robot_can_be_pulled_and_what_is_let_go_is_free():
    plant = Plant(ball_scene())
    body = plant.layout.body_name[plant.layout.entity("base").bodies[-1]]
    before = plant.state.joint_q.copy()
    plant.perturbation.grab(body, at(plant, body)[:3])
    plant.perturbation.pull(at(plant, body)[:3] + (0.0, -1.0, 0.0))
    hold(plant, 0.4)
    moved = plant.state.joint_q.copy()
    assert moved[1] < before[1] - 0.001
    plant.perturbation.release()
    hold(plant, 1.0)
    assert abs(plant.state.joint_qd[1]) < 0.01


def test_a_reset_lets_go():
    plant, free = Plant(ball_scene()), Plant(ball_scene())
    plant.perturbation.grab("ball", at(plant, "ball")[:3])
    plant.perturbation.pull((3.0, 2.0, 1.0))
    hold(plant, 0.2)
    plant.reset()
    assert plant.perturbation.body is None
    for each in (plant, free):
        hold(each, 0.2)
    np.testing.assert_array_equal(plant.state.joint_q, free.state.joint_q)


def test_plants_of_a_batch_are_pulled_each_by_itself():
    plants = Plant(ball_scene(), envs=2)
    first, second = plants.plants
    first.perturbation.grab("ball", at(first, "ball")[:3])
    first.perturbation.pull((1.0, 2.0, 0.3))
    for _ in range(10):
        plants.apply(np.zeros((2, 3)))
    assert at(first, "ball")[0] > 0.2
    assert abs(at(second, "ball")[0]) < 1e-3


def test_a_body_that_is_not_there_is_told():
    with pytest.raises(SceneError, match="no such body"):
        Plant(ball_scene()).perturbation.grab("bal", REST)
