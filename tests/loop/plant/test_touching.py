# SPDX-License-Identifier: Apache-2.0
"""Contacts between things that move, and starts at which things stand inside each other."""

import numpy as np
import pytest
from small_scenes import BOX, DISC, WALL, compiled, make_engine, make_scene, roll

from warpmpc import Plant, SceneError, load_scene
from warpmpc.scene.model.pairs import Pair

LEFT, RIGHT = ({**DISC, "name": name, "position": (x, 0.0, 0.0)} for name, x in (("left", -0.5), ("right", 0.5)))
HEAD_ON = np.array([1.0, 0.0, 0.0, -1.0, 0.0, 0.0])
WATCHED = [{"term": "contact_force", "between": ["left", "right"]}]


def two_robots(**sections):
    goal = {"frame": "left/centre", "position": (1.0, 0.0)}
    return make_scene(**{"robot": [LEFT, RIGHT], "goal": goal, "cost": WATCHED, **sections})


def make_plant(scene) -> Plant:
    return Plant(scene, compiled=compiled(scene))


def test_a_head_on_crash_of_two_robots_shows_its_force():
    plant = make_plant(two_robots())
    plant.apply(HEAD_ON)
    assert plant.contact.forces == {"left-right": 0.0}
    for _ in range(20):
        plant.apply(HEAD_ON)
    # in the end two servos of damping 300 N·s/m push with 1 m/s each, held back by at most 200 N
    assert plant.contact.max_force == plant.contact.forces["left-right"] > 150.0
    assert plant.contact.time > 0.1
    np.testing.assert_allclose(np.abs(plant.forces[0, 0]), 200.0, rtol=0.1)


def test_two_robots_are_watched_in_rollouts():
    scene = two_robots()
    engine = make_engine(scene, horizon=20, pairs=(Pair("left", "right"),))
    out = roll(engine, np.tile(HEAD_ON, (20, 1, 1)), np.zeros(6), np.zeros(6))
    force = np.linalg.norm(out.contact_force.numpy()[:, 0, 0], axis=-1)
    assert force[0] == 0.0
    assert force[-1] > 100.0


def test_pushing_is_told_and_is_no_collision():
    scene = make_scene(object=[{**BOX, "position": (0.5, 0.0, 0.1)}])
    plant = make_plant(scene)
    for _ in range(15):
        plant.apply(np.array([1.0, 0.0, 0.0]))
    assert plant.contact.touches["base-box"] > 1.0
    assert (plant.contact.forces, plant.contact.max_force, plant.contact.time) == ({}, 0.0, 0.0)
    plant.reset()
    assert plant.contact.touches == {}


def test_objects_that_lie_on_each_other_are_told():
    stack = [
        {**BOX, "position": (2.0, 0.0, 0.1)},
        {**BOX, "name": "top", "size": (0.2, 0.2, 0.2), "position": (2.0, 0.0, 0.3)},
    ]
    plant = make_plant(make_scene(object=stack))
    for _ in range(10):
        plant.apply(np.zeros(3))
    assert 9.0 < plant.contact.touches["box-top"] < 50.0  # its weight at least, and no blow


@pytest.mark.parametrize(
    ("sections", "says"),
    [
        (
            {"object": [{**BOX, "position": (1.5, 0.0, 0.2)}], "obstacle": [WALL]},
            "object.box: 'box' and 'wall' overlap",
        ),
        ({"object": [{**BOX, "position": (3.0, 0.0, 0.05)}]}, "object.box: 'box' and 'ground' overlap by 0.05 m"),
        ({"object": [{**BOX, "position": (0.1, 0.0, 0.1)}]}, "robot.base: 'base' and 'box' overlap by"),
    ],
)
def test_a_start_in_deep_overlap_is_refused_with_names_and_depth(sections, says):
    with pytest.raises(SceneError) as caught:
        make_plant(make_scene(**sections))
    assert says in str(caught.value)
    assert "change the position" in str(caught.value)
    assert ("(link base/base_link)" in str(caught.value)) == ("robot.base" in says)


def test_two_robots_in_each_other_are_refused():
    with pytest.raises(SceneError, match=r"robot\.right: 'right' and 'left' overlap by 0\.\d+ m"):
        make_plant(two_robots(robot=[LEFT, {**RIGHT, "position": (-0.3, 0.0, 0.0)}]))


def test_a_millimetre_settles():
    plant = make_plant(make_scene(object=[{**BOX, "position": (3.0, 0.0, 0.099)}]))
    for _ in range(10):
        plant.apply(np.zeros(3))
    assert plant.state.joint_q[5] == pytest.approx(0.1, abs=2e-3)


def test_an_object_that_is_drawn_larger_may_stand_deeper_in_the_ground():
    """At this seed the ball's radius is drawn 0.011 m larger."""
    plant = Plant(load_scene("omni_push_sphere:A"), seed=100057)
    assert plant.properties.size.max() > 0.01
    assert not plant.done
