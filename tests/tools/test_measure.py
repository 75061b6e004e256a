# SPDX-License-Identifier: Apache-2.0
"""Measures of a plant: clearance, path, smoothness."""

import numpy as np
import pytest
from shared.measure import Clearance, Meter
from small_scenes import BOX, compiled, make_scene

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
