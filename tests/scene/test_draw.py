# SPDX-License-Identifier: Apache-2.0
"""Tasks drawn from a seed, and the distances that reject a draw."""

import math

import numpy as np
import pytest
from scene_text import SMALL, write

from warpmpc import SceneError, State, load_scene, shipped_scenes
from warpmpc.scene.draw import clearance, draw_task, signed_distance
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.schema import Obstacle


@pytest.fixture(scope="module")
def reach():
    return load_scene("point_reach")


def test_the_same_seed_draws_the_same_task(reach):
    (first, values), (again, same) = draw_task(reach, 3), draw_task(reach, 3)
    assert first == again
    assert values == same
    assert draw_task(reach, 4)[1] != values


def test_the_order_in_the_file_does_not_matter(reach):
    task = reach.randomize_task
    turned = task.model_copy(update={"draw": dict(reversed(task.draw.items()))})
    assert draw_task(reach.model_copy(update={"randomize_task": turned}), 5)[1] == draw_task(reach, 5)[1]


def test_drawn_values_are_in_range_in_the_scene_and_named_in_full(reach):
    for seed in range(50):
        scene, values = draw_task(reach, seed)
        assert len(values) == 11
        assert values["goal.position"] == scene.goal.position
        assert max(map(abs, scene.goal.position)) <= 5.0
        for ball in scene.obstacle:
            assert values[f"obstacle.{ball.name}.position"] == ball.position
            assert (values[f"obstacle.{ball.name}.size"],) == ball.size
            assert 0.1 <= ball.size[0] <= 0.5
            assert 1.0 <= ball.position[0] <= 4.0
            assert ball.position[2] == 0.0
        assert (scene.name, scene.robot) == (reach.name, reach.robot)


def test_no_draw_leaves_start_or_goal_in_an_obstacle(reach):
    for seed in range(100):
        scene, _ = draw_task(reach, seed)
        for ball in scene.obstacle:
            for x, y in (scene.goal.position, (0.1, 0.0)):
                assert math.hypot(x - ball.position[0], y - ball.position[1]) >= ball.size[0] + 0.25 - 1e-12


def test_a_scene_without_draws_stays_as_it_is(tmp_path):
    scene = load_scene(write(tmp_path))
    assert draw_task(scene, 0) == (scene, {})


DRAW = """
[randomize_task.draw]
"goal.position" = { low = [0.9, 0.9], high = [1.1, 1.1] }
[[randomize_task.reject]]
place = "goal"
clearance = 0.1
"""


def test_an_impossible_draw_ends_in_an_error_that_names_it(tmp_path):
    scene = load_scene(write(tmp_path, SMALL + DRAW))
    with pytest.raises(SceneError, match=r"1000 draws of goal\.position all leave goal closer than 0\.1 m") as caught:
        draw_task(scene, 0)
    assert caught.value.file == scene.path


def test_places_are_goals_objects_and_robots(tmp_path):
    reject = """
    [randomize_task]
    reject = [
        { place = "goal", clearance = 0 },
        { place = "box", clearance = 0 },
        { place = "base", clearance = 0 },
        { place = "base/tip", at = [-1.0, 2.0, 0.0], clearance = 0 },
    ]
    """
    path = write(tmp_path, SMALL.replace("[planner]", f"{reject}\n[planner]"))
    scene = load_scene(path, overrides=["object.box.position=[-1, 1.5, 0]", "robot.base.position=[-1, 0, 0]"])
    goal, box, base, tip = (clearance(scene, rejection) for rejection in scene.randomize_task.reject)
    assert goal == pytest.approx(math.hypot(0.7, 0.6))
    assert box == pytest.approx(0.3)
    assert base == pytest.approx(0.8)
    assert tip == pytest.approx(0.8)


def obstacle(shape, size=None, position=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0)):
    return Obstacle(name="it", shape=shape, size=size, position=position, rotation=rotation)


@pytest.mark.parametrize(
    ("shape", "size", "point", "distance"),
    [
        ("sphere", (0.5,), (0.0, 2.0, 0.0), 1.5),
        ("sphere", (0.5,), (0.1, 0.0, 0.0), -0.4),
        ("box", (2.0, 4.0, 6.0), (2.0, 0.0, 0.0), 1.0),
        ("box", (2.0, 4.0, 6.0), (4.0, 6.0, 0.0), 5.0),
        ("box", (2.0, 4.0, 6.0), (0.9, 0.0, 0.0), -0.1),
        ("cylinder", (1.0, 2.0), (0.0, 3.0, 0.0), 2.0),
        ("cylinder", (1.0, 2.0), (0.0, 0.0, 3.0), 2.0),
        ("cylinder", (1.0, 2.0), (4.0, 0.0, 5.0), 5.0),
        ("cylinder", (1.0, 2.0), (0.0, 0.5, 0.0), -0.5),
        ("capsule", (1.0, 2.0), (0.0, 0.0, 3.0), 1.0),
        ("capsule", (1.0, 2.0), (3.0, 0.0, 0.5), 2.0),
        ("capsule", (1.0, 2.0), (0.0, 0.0, 0.0), -1.0),
        ("plane", None, (7.0, 8.0, 0.3), 0.3),
    ],
)
def test_distances_are_exact(shape, size, point, distance):
    assert signed_distance(obstacle(shape, size), point) == pytest.approx(distance)


def test_a_rotated_obstacle_is_a_rotated_world():
    rng = np.random.default_rng(0)
    for shape, size in [("box", (0.3, 0.8, 1.5)), ("cylinder", (0.4, 1.0)), ("capsule", (0.2, 1.0)), ("plane", None)]:
        for _ in range(20):
            q = rng.normal(size=4)
            x, y, z, w = q / np.linalg.norm(q)
            turn = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            )
            point, position = rng.normal(size=3), rng.normal(size=3)
            turned = obstacle(shape, size, tuple(map(float, position)), (float(x), float(y), float(z), float(w)))
            expected = signed_distance(obstacle(shape, size), tuple(point))
            assert signed_distance(turned, tuple(turn @ point + position)) == pytest.approx(expected, abs=1e-12)


def test_a_goal_without_height_lies_at_the_obstacles_height():
    ball = obstacle("sphere", (0.5,), (1.0, 0.0, 7.0))
    assert signed_distance(ball, (3.0, 0.0)) == pytest.approx(1.5)
    assert signed_distance(ball, (3.0, 0.0, 7.0)) == pytest.approx(1.5)


def test_meshes_are_left_out(tmp_path):
    text = SMALL + '[[obstacle]]\nname = "rock"\nshape = "mesh"\nmesh = "rock.stl"\nposition = [2, 0, 0]\n'
    text = text.replace("[planner]", '[randomize_task]\nreject = [{ place = "goal", clearance = 0.1 }]\n[planner]')
    scene = load_scene(write(tmp_path, text))
    assert clearance(scene, scene.randomize_task.reject[0]) > 0.5


def test_starts_that_are_drawn_lie_about_the_keyframe_that_a_scene_names():
    """A drawn joint_q takes the place of the keyframe: a cart was to swing its pole up that stood already."""
    looked_at = []
    for name in shipped_scenes():
        scene = load_scene(name)
        (robot, *others), draws = scene.robot, scene.randomize_task.draw
        draw = draws.get(f"robot.{robot.name}.joint_q")
        if robot.keyframe and draw and not others:
            start = State.start(compile_scene(scene).layout).joint_q
            assert (np.array(draw.low) <= start).all() and (start <= np.array(draw.high)).all(), name  # noqa: PT018
            looked_at.append(name)
    assert "cartpole_swingup" in looked_at
