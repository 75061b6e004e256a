# SPDX-License-Identifier: Apache-2.0
"""Depth cameras of plants: points on surfaces that face them, at their pace, without the robot."""

import numpy as np
import pytest
from small_scenes import DISC, compiled, make_scene

from warpmpc import Plant, SceneError
from warpmpc.loop.plant.sensors import pixel_rays
from warpmpc.scene.schema import Camera

CAMERA = {"position": (-1.5, 0.0, 1.0), "look_at": (1.5, 0.0, 0.2), "width": 60, "height": 40, "far": 4.0}
WALL = {"name": "wall", "shape": "box", "size": (0.2, 2.0, 0.4), "position": (1.5, 0.0, 0.2)}
CLOUD = {"name": "seen", "low": (-1.0, -2.0, 0.05), "high": (2.0, 2.0, 1.0)}


def plant_with(seed: int = 0, *, camera: dict | None = None, **sections) -> Plant:
    """A disc before a wall, without a floor, seen from behind."""
    cloud = {**CLOUD, "camera": {**CAMERA, **(camera or {})}}
    scene = make_scene(**{"ground": False, "obstacle": [WALL], "cloud": [cloud], **sections})
    return Plant(scene, seed=seed, compiled=compiled(scene))


def beyond_wall(points: np.ndarray) -> np.ndarray:
    """Distance of points from the wall's surface."""
    q = np.abs(points - WALL["position"]) - 0.5 * np.array(WALL["size"])
    return np.abs(np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0))


def test_points_lie_on_the_sides_that_face_the_camera():
    plant = plant_with()
    assert len(plant.task["seen"]) == 0
    plant.observe()
    points = plant.task["seen"]
    assert len(points) > 80
    assert beyond_wall(points).max() < 1e-5  # nor is any on the disc
    assert (points[:, 0] < 1.59).all()  # the back is hidden


@pytest.mark.parametrize("noise", [0.003, 0.02])
def test_noise_moves_points_along_their_rays(noise):
    exact, noisy = plant_with(), plant_with(camera={"noise": noise})
    for plant in (exact, noisy):
        plant.observe()
    depth = [np.linalg.norm(p.task["seen"] - CAMERA["position"], axis=1) for p in (exact, noisy)]
    assert np.std(depth[1] - depth[0]) == pytest.approx(noise, rel=0.1)
    again = plant_with(camera={"noise": noise})
    again.observe()
    np.testing.assert_array_equal(again.task["seen"], noisy.task["seen"])


def test_pictures_come_at_their_pace():
    plant = plant_with(camera={"rate": 10.0, "noise": 0.001})
    pictures = []
    for _ in range(11):  # 0.4 s at 25 Hz
        plant.observe()
        pictures.append(plant.task["seen"].tobytes())
        plant.apply(np.zeros(3))
    assert len(set(pictures)) == 5
    plant.reset()
    plant.observe()
    assert plant.task["seen"].tobytes() == pictures[0]


def test_what_the_robot_hides_stays_where_it_was_seen():
    plant = plant_with(robot=[{**DISC, "joint_q": (0.0, -2.5, 0.0)}], camera={"look_at": (1.5, 0.0, 0.0)})
    plant.observe()
    before = plant.task["seen"]
    plant._engine.initial[0, 1:4] = (-1.0, 0.0, 0.0)  # right before the camera
    plant.steps += 1
    plant.observe()
    np.testing.assert_array_equal(plant.task["seen"], before)


def test_each_plant_of_a_batch_fills_its_own_cloud():
    scene = plant_with(camera={"noise": 0.01}).scene
    batch = Plant(scene, envs=2)
    batch.observe()
    first, second = (batch.plants[e].task.points("seen", e) for e in range(2))
    assert first.shape == second.shape
    assert (first != second).any()


def test_rays_go_through_the_pixels():
    rays = pixel_rays(Camera(**CAMERA)).reshape(40, 60, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0)
    ahead = np.subtract(CAMERA["look_at"], CAMERA["position"])
    assert rays[19:21, 29:31].mean(axis=(0, 1)) @ ahead / np.linalg.norm(ahead) == pytest.approx(1.0, abs=1e-3)
    assert (rays[0, :, 2] > rays[-1, :, 2]).all()  # the first row is the upper one
    assert (rays[:, 0, 1] > rays[:, -1, 1]).all()  # left is +y for who looks along +x


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        ({"high": (-2.0, 0.0, 0.0)}, "low = .* below high"),
        ({"voxel": 0.001}, "take a larger voxel"),
        ({"behind": 0.1}, "give eye"),
        ({"capacity": 100, "camera": CAMERA}, "more pixels"),
        ({"camera": {**CAMERA, "look_at": (-1.5, 0.0, 0.0)}}, "straight up or down"),
    ],
)
def test_clouds_that_cannot_be_are_errors(cloud, message):
    with pytest.raises((ValueError, SceneError), match=message):
        make_scene(cloud=[{**CLOUD, **cloud}])
