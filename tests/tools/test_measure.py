# SPDX-License-Identifier: Apache-2.0
"""What tools measure of a plant, and the geometric planner they measure against."""

import itertools

import numpy as np
import pytest
from baselines import MARGIN, Disc, Follower, plan_path, run_geometric
from measure import Clearance, Meter
from needs import need
from small_scenes import BOX, compiled, make_scene

import warpmpc
from warpmpc import Plant
from warpmpc.scene.draw import signed_distance

SPHERES = [
    {"name": "near", "shape": "sphere", "size": 0.3, "position": (0.9, 0.1, 0.06)},
    {"name": "far", "shape": "sphere", "size": 0.4, "position": (2.0, -0.6, 0.06)},
]


def disc_among(obstacles) -> Plant:
    scene = make_scene(obstacle=obstacles, goal={"frame": "base/centre", "position": (3.0, 0.0)})
    return Plant(scene, compiled=compiled(scene))


def test_clearance_of_a_disc_is_its_distance_less_its_radius():
    plant = disc_among(SPHERES)
    clearance = Clearance(plant.compiled)
    base = plant.layout.frame_body[plant.layout.frame("base/centre")]
    rng = np.random.default_rng(0)
    for _ in range(20):
        body_q = plant.body_q
        body_q[base, :2] = rng.uniform(-1.0, 3.0, 2)
        expected = min(signed_distance(o, tuple(body_q[base, :2])) for o in plant.scene.obstacle) - 0.2
        if expected > 0.0:
            assert clearance(body_q) == pytest.approx(expected, abs=2e-3)
        else:
            assert clearance(body_q) < 0.0


def test_nothing_to_hit_is_infinitely_far():
    scene = make_scene(object=[BOX])
    plant = Plant(scene, compiled=compiled(scene))
    assert Clearance(plant.compiled)(plant.body_q) == np.inf
    assert Meter(plant).to_json()["clearance_m"] is None


def test_a_meter_follows_the_goals_frame():
    plant = disc_among(SPHERES[1:])
    meter = Meter(plant)
    places = [plant.state.joint_q[:2].copy()]
    for t in range(20):
        control = np.array([1.0, 0.5 - 0.1 * t, 0.0], dtype=np.float32)
        plant.apply(control)
        meter(None, plant, control)
        places.append(plant.state.joint_q[:2].copy())
    found = meter.to_json()
    assert found["path_length_m"] == pytest.approx(np.linalg.norm(np.diff(places, axis=0), axis=1).sum(), rel=1e-4)
    nearest = min(np.hypot(*(place - [2.0, -0.6])) for place in places) - 0.4 - 0.2
    assert found["clearance_m"] == pytest.approx(nearest, abs=5e-3)
    assert found["start_position_error_m"] == pytest.approx(3.0)
    jerk = np.diff(np.array(places, dtype=float), 3, axis=0) / 0.04**3
    assert found["squared_jerk_m2_s5"] == pytest.approx(0.04 * np.sum(jerk**2), rel=1e-3)
    assert found["squared_control_rate"] == pytest.approx(19 * 0.1**2 / 0.04, rel=1e-4)
    assert found["axes_error_m"][0] == pytest.approx(places[-1][0] - 3.0, abs=1e-4)


def test_a_planned_path_goes_around_and_is_the_same_again():
    need("ompl")
    disc = Disc(0.2, np.array([[1.0, 0.05, 0.3], [2.0, -0.4, 0.4], [2.0, 0.9, 0.3]]))
    path = plan_path(disc, np.zeros(2), np.array([3.0, 0.0]), seed=4)
    np.testing.assert_array_equal(path, plan_path(disc, np.zeros(2), np.array([3.0, 0.0]), seed=4))
    np.testing.assert_allclose(path[[0, -1]], [[0.0, 0.0], [3.0, 0.0]])
    share = np.linspace(0.0, 1.0, 50)[:, None]
    fine = np.concatenate([a + share * (b - a) for a, b in itertools.pairwise(path)])
    for x, y, radius in disc.circles:
        assert np.hypot(*(fine - [x, y]).T).min() > radius + disc.radius + MARGIN - 5e-3
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() < 3.6
    walled = Disc(0.2, np.array([[3.0 + np.cos(a), np.sin(a), 0.3] for a in np.linspace(0.0, 2.0 * np.pi, 9)]))
    assert plan_path(walled, np.zeros(2), np.array([3.0, 0.0]), seed=0) is None


def test_the_follower_drives_at_the_limit_to_the_end():
    follow, place = Follower(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), np.array([2.5, 2.5])), np.zeros(2)
    for _ in range(20):
        velocity = follow(place)
        assert np.abs(velocity).max() == pytest.approx(2.5)
        place = place + 0.04 * velocity
        if np.hypot(*(place - 1.0)) < 0.15:
            return
    raise AssertionError("did not arrive")


def test_the_geometric_planner_drives_around_to_the_goal():
    need("ompl")
    run = run_geometric(disc_among(SPHERES).scene, seed=3)
    assert run["result"]["success"], run
    assert run["result"]["engine"] == "ompl"
    assert run["result"]["collisions"]["max_force_N"] == 0.0
    assert 0.0 < run["measured"]["clearance_m"] < 0.1
    assert 2.9 < run["measured"]["path_length_m"] < 3.6


@pytest.mark.slow
def test_the_geometric_planner_reaches_drawn_goals():
    need("ompl")
    scene = warpmpc.load_scene("point_reach")
    runs = [run_geometric(scene, seed=seed) for seed in range(20)]
    assert sum(run["result"]["success"] and run["result"]["collisions"]["max_force_N"] == 0.0 for run in runs) >= 19


def test_other_robots_are_refused():
    with pytest.raises(warpmpc.SceneError, match="one disc"):
        run_geometric(warpmpc.load_scene("omni_push_box"), seed=0)
