# SPDX-License-Identifier: Apache-2.0
"""Training of checkers of links against clouds: what is true, what the camera shows, and that something is learned."""

import numpy as np
import pytest
from studies.arms.learned.clutter import Clutter
from studies.arms.train_cloud_checker import Link, errors, gathered, trained

from warpmpc import SceneError, load_scene
from warpmpc.scene.draw import signed_distance
from warpmpc.scene.model.compiled import compile_scene


@pytest.fixture(scope="module")
def scene():
    return load_scene("storm_cloud")


def test_distances_are_those_that_draws_are_rejected_by(scene):
    clutter, rng = Clutter.drawn(scene, 3), np.random.default_rng(0)
    points = rng.uniform([0.2, -0.5, -0.1], [0.9, 0.5, 0.8], (200, 3))
    wanted = [min(signed_distance(obstacle, tuple(p)) for obstacle in clutter.obstacles) for p in points]
    np.testing.assert_allclose(clutter.distance(points), wanted, atol=1e-9)


def test_the_camera_shows_the_sides_of_obstacles_that_it_sees(scene):
    clutter = Clutter.drawn(scene, 3)
    cloud = clutter.seen()
    assert len(cloud) > 10_000
    assert np.quantile(np.abs(clutter.distance(cloud)), 0.95) < 0.012  # 3 mm of noise
    volume = clutter.volume()
    assert (volume.at(cloud[::50].astype(float)) < 0.026).mean() > 0.9


def test_a_link_is_learned(scene):
    link = Link.of(compile_scene(scene).layout, "panda_hand")
    views = {}
    data, test = (gathered(link, scene, seeds, 60, views) for seeds in (range(6), range(6, 9)))
    assert 0.2 < test.hit.mean() < 0.8
    assert not test.hit[~test.near].any()
    network = trained(data, 300, np.random.default_rng(0))
    missed, wrong = errors((network(test.features) > 0.0) & test.near, test.hit)
    assert missed + wrong < 0.6


def test_a_link_that_does_not_exist_is_told(scene):
    with pytest.raises(SceneError, match=r"no such link.*Did you mean 'panda_link5'"):
        Link.of(compile_scene(scene).layout, "panda_lnik5")
