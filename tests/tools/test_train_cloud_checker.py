# SPDX-License-Identifier: Apache-2.0
"""Checkers of links against clouds: what is true, what geometry says, and that training finds something."""

import numpy as np
import pytest
from arms import arm_layout
from learned.clutter import HIGH, LOW, Clutter, Volume, drawn_poses
from scipy.spatial import cKDTree
from train_cloud_checker import ALIKE, FEATURES, Judged, Link, Poses, by_points, by_spheres, compare, scenes, truly

from warpmpc import SceneError

OVERHANGS = [0.03]


def one_ball(radius: float = 0.08) -> Clutter:
    return Clutter(np.array([2]), np.array([[0.5, 0.0, 0.3]]), np.zeros(1), np.full((1, 3), radius))


@pytest.fixture(scope="module")
def link() -> Link:
    return Link.of(arm_layout("panda"), "panda_link5", OVERHANGS)


def test_a_cloud_lies_on_what_is_seen_and_shows_one_side():
    rng = np.random.default_rng(0)
    clutter = one_ball()
    cloud = clutter.seen(rng, noise=0.0)
    assert len(cloud) > 100
    assert np.abs(clutter.distance(cloud)).max() < 0.003  # rays that graze it end a little early
    towards = (cloud - clutter.centre[0]).mean(axis=0)
    assert (((cloud - clutter.centre[0]) @ towards) > -1e-3).mean() > 0.99


@pytest.mark.parametrize("seed", range(3))
def test_clutter_has_things_on_a_table(seed):
    clutter = Clutter.drawn(np.random.default_rng(seed))
    cloud = clutter.seen(np.random.default_rng(seed))
    assert 5 <= len(clutter.kind) <= 13
    assert np.quantile(np.abs(clutter.distance(cloud)), 0.95) < 0.01
    assert ((cloud > LOW) & (cloud < HIGH)).all()


def test_distances_are_those_of_boxes_cylinders_and_balls():
    size = np.array([[0.1, 0.2, 0.3], [0.1, 0.1, 0.3], [0.1, 0.1, 0.1]])
    far = np.array([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    for kind, wanted in enumerate(([0.4, 0.3, 0.2, -0.1], [0.4, 0.4, 0.2, -0.1], [0.4, 0.4, 0.4, -0.1])):
        clutter = Clutter(np.array([kind]), np.zeros((1, 3)), np.zeros(1), size[kind : kind + 1])
        np.testing.assert_allclose(clutter.distance(far), wanted, atol=1e-12)
    turned = Clutter(np.array([0]), np.zeros((1, 3)), np.array([np.pi / 2]), size[:1])
    np.testing.assert_allclose(turned.distance(far), [0.3, 0.4, 0.2, -0.1], atol=1e-12)


def test_the_volume_knows_distances_to_millimetres():
    rng = np.random.default_rng(0)
    cloud = Clutter.drawn(rng).seen(rng)
    points = rng.uniform(LOW, HIGH, (2000, 3))
    exact = cKDTree(cloud).query(points)[0]
    near = exact < 0.15
    found = Volume.of(cloud, 0.025).at(points)[near] - exact[near]
    assert np.quantile(np.abs(found), 0.95) < 0.006


def test_a_link_hits_what_it_overlaps(link):
    clutter = one_ball()
    centre = link.surface.mean(axis=0)
    at = clutter.centre[0] - centre + np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    assert truly(clutter, link, Poses(at, np.tile(np.eye(3), (2, 1, 1)))).tolist() == [True, False]
    # seen all around, and not from one side alone, the cloud tells as much
    rng = np.random.default_rng(1)
    cloud = rng.normal(size=(4000, 3))
    cloud = clutter.centre[0] + 0.08 * cloud / np.linalg.norm(cloud, axis=1)[:, None]
    poses = Poses(*drawn_poses(80, rng))
    hit = truly(clutter, link, poses)
    assert 0.05 < hit.mean() < 0.5
    assert (by_points(cloud, link, poses)[hit] < 0.005).all()
    assert (by_points(cloud, link, poses)[~hit] > -0.005).all()
    clearance = by_spheres(Volume.of(cloud, 0.025), link, poses, OVERHANGS[0])
    assert (clearance[hit] < 0.0).all()  # spheres cover the link
    assert (clearance[~hit] < 0.0).mean() < 0.15


def test_shares_of_mistakes_are_counted():
    checker = Judged(np.array([-1.0, 1.0, 2.0, -1.0, 3.0]), np.array([True, True, False, False, False]), 0.0)
    assert checker.errors() == (0.5, pytest.approx(1.0 / 3.0))
    assert checker.errors(1.5) == (0.0, pytest.approx(1.0 / 3.0))


def test_training_finds_collisions_that_it_has_not_seen(link):
    data = [scenes([link], count, 60, seed) for seed, count in enumerate((10, 3))]
    found = compare([link], *data, OVERHANGS, steps=400, seed=0)
    assert set(found) >= {f"learned, {kind}" for kind in FEATURES}
    checker = found["learned, distance"]
    missed, wrong = checker.errors()
    assert missed < 0.4
    assert wrong < 0.25
    assert checker.at_equal_terms(ALIKE[0]) < 0.8
    assert all(c.seconds > 0.0 for c in found.values())


def test_a_link_that_does_not_exist_is_told():
    with pytest.raises(SceneError, match=r"no such link.*Did you mean 'panda_link5'"):
        Link.of(arm_layout("panda"), "panda_lnik5", OVERHANGS)
