# SPDX-License-Identifier: Apache-2.0
"""Spheres that cover links, measured against the shapes themselves, and pairs of links that may collide."""

import itertools
import time

import numpy as np
import pytest
import trimesh
from arms import ARMS, arm_layout, outside, solid
from small_scenes import layout_of, make_scene

from warpmpc.scene.model.layout import Layout
from warpmpc.scene.model.pairs import self_pairs
from warpmpc.scene.model.spheres import Group, Spheres, _known, fit_spheres


def fitted(name: str) -> tuple[Layout, Spheres]:
    layout = arm_layout(name)
    return layout, fit_spheres(layout, range(layout.nb))


def own(spheres: Spheres, group: Group) -> tuple[np.ndarray, np.ndarray]:
    chosen = slice(group.first, group.first + group.count)
    return spheres.centre[chosen].astype(np.float64), spheres.radius[chosen].astype(np.float64)


def stick_out(points: np.ndarray, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
    return (np.linalg.norm(points[:, None] - centre, axis=2) - radius).min(axis=1)


def measure(layout: Layout, spheres: Spheres) -> tuple[np.ndarray, np.ndarray]:
    """How far points of the shapes' surfaces are outside the spheres, and points of the spheres' outside the shapes."""
    bare, over = [], []
    probes = np.random.default_rng(0).normal(size=(24, 3))
    probes /= np.linalg.norm(probes, axis=1)[:, None]
    for group in spheres.groups:
        meshes = [solid(layout, s) for s in layout.shapes if s.body == group.body and s.collides]
        centre, radius = own(spheres, group)
        bare += [stick_out(trimesh.sample.sample_surface(m, 1500, seed=1)[0], centre, radius) for m in meshes]
        points = (centre[:, None] + radius[:, None, None] * probes).reshape(-1, 3)
        points = points[stick_out(points, centre, radius) > -1e-6]
        over.append(np.min([outside(mesh, points) for mesh in meshes], axis=0))
    return np.concatenate(bare), np.concatenate(over)


@pytest.mark.parametrize(
    ("name", "mean", "p95"), [("panda", 18, 32), ("panda_meshes", 21, 40), ("ur10", 28, 52), ("kinova", 18, 32)]
)
def test_few_spheres_cover_an_arm_and_stick_out_little(name, mean, p95):
    layout, spheres = fitted(name)
    bare, over = measure(layout, spheres)
    print(
        f"{name}: {len(spheres)} spheres, covered {(bare < 1e-5).mean():.4f}, {1e3 * bare.max():.2f} mm bare,", end=" "
    )
    print(f"sticking out {1e3 * over.mean():.1f} mm on average, p95 {1e3 * np.quantile(over, 0.95):.1f} mm")
    assert 20 <= len(spheres) <= 45
    assert (bare < 1e-5).mean() >= 0.99
    assert bare.max() < 2e-3
    assert 1e3 * over.mean() < mean
    assert 1e3 * np.quantile(over, 0.95) < p95


def test_a_mobile_base_is_covered_too():
    layout, spheres = fitted("mobile_panda")
    bare, _ = measure(layout, spheres)
    assert len(spheres) <= 45
    assert (bare < 1e-5).mean() >= 0.99


@pytest.mark.parametrize("name", ["panda", "ur10"])
def test_the_same_layout_gives_the_same_spheres_soon(name):
    layout, first = fitted(name)
    _known.clear()
    start = time.process_time()
    again = fit_spheres(layout, range(layout.nb))
    assert time.process_time() - start < 4.0  # half a second on an idle core
    np.testing.assert_array_equal(first.centre, again.centre)
    np.testing.assert_array_equal(first.radius, again.radius)
    assert first.groups == again.groups


@pytest.mark.parametrize("name", ARMS)
def test_spheres_stand_by_body_with_few_radii_and_a_sphere_around_them(name):
    layout, spheres = fitted(name)
    assert [group.first for group in spheres.groups] == np.cumsum([0, *(g.count for g in spheres.groups)])[:-1].tolist()
    assert {g.body for g in spheres.groups} == {s.body for s in layout.shapes if s.collides and s.body >= 0}
    for group in spheres.groups:
        centre, radius = own(spheres, group)
        assert (spheres.body[group.first : group.first + group.count] == group.body).all()
        assert len(np.unique(radius)) <= 2
        assert (np.diff(radius) <= 0.0).all()
        assert (np.linalg.norm(centre - group.centre, axis=1) + radius <= group.radius).all()


SHAPES = """
<mujoco><worldbody>
  <body name="ball"><freejoint/><geom type="sphere" size=".1" pos=".2 0 .1"/></body>
  <body name="egg" pos="1 0 0"><freejoint/><geom type="ellipsoid" size=".1 .05 .2" quat=".8 .6 0 0"/></body>
  <body name="can" pos="2 0 0"><freejoint/><geom type="cylinder" size=".05 .2" euler="30 40 50"/></body>
  <body name="two" pos="3 0 0"><freejoint/><geom type="box" size=".02 .1 .2"/>
    <geom type="capsule" size=".03 .1" pos=".1 0 .1"/></body>
  <body name="bare" pos="4 0 0"><freejoint/><geom type="box" size=".1 .1 .1" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>
"""


def shapes_layout(tmp_path) -> Layout:
    (tmp_path / "shapes.xml").write_text(SHAPES)
    robot = {"name": "arm", "asset": str(tmp_path / "shapes.xml")}
    base = {"name": "base", "asset": "point_robot.urdf", "drive": {"damping": 300.0, "limit": 1.0}}
    return layout_of(make_scene(robot=[robot, base], goal=None, success={"conditions": {"joint": "x", "above": 0.0}}))


def test_every_kind_of_shape_is_covered(tmp_path):
    layout = shapes_layout(tmp_path)
    bodies = [layout.body_name.index(f"arm/{name}") for name in ("ball", "egg", "can", "two", "bare")]
    spheres = fit_spheres(layout, bodies)
    bare, over = measure(layout, spheres)
    assert bare.max() < 2e-3
    assert np.quantile(over, 0.95) < 0.09  # much of a plate's spheres
    assert [group.body for group in spheres.groups] == bodies[:4]  # what collides with nothing needs none
    ball = spheres.groups[0]
    assert ball.count == 1
    np.testing.assert_allclose(own(spheres, ball)[0][0], [0.2, 0.0, 0.1], atol=2e-3)
    assert own(spheres, ball)[1][0] == pytest.approx(0.1, abs=3e-3)


def test_less_may_stick_out_of_more_spheres():
    layout = arm_layout("panda")
    coarse, fine = (fit_spheres(layout, range(layout.nb), overhang=overhang) for overhang in (0.06, 0.03))
    assert len(coarse) < len(fine)
    assert measure(layout, coarse)[1].mean() > measure(layout, fine)[1].mean()


def test_given_spheres_stand_in_place_of_fitted_ones():
    layout = arm_layout("panda")
    spheres = fit_spheres(layout, [0, 3], given={3: [(0.0, 0.0, 0.1, 0.05), (0.0, 0.0, 0.0, 0.08)]})
    centre, radius = own(spheres, spheres.groups[1])
    np.testing.assert_allclose(radius, [0.08, 0.05])  # the larger first
    np.testing.assert_allclose(centre, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]], atol=1e-7)
    assert [g.body for g in fit_spheres(layout, [0, 3], given={0: []}).groups] == [3]


def names(layout: Layout, spheres: Spheres, pairs) -> set[tuple[str, str]]:
    link = [layout.body_name[g.body].split("panda_")[-1] for g in spheres.groups]
    return {(link[a], link[b]) for a, b in pairs}


def test_links_that_cannot_collide_are_no_pair():
    layout, spheres = fitted("panda_meshes")
    pairs = names(layout, spheres, self_pairs(layout, spheres))
    links = [f"link{i}" for i in range(8)]
    assert not any(pair in pairs for pair in itertools.pairwise(links))  # one joint between them
    assert ("link7", "hand") not in pairs  # a fixed joint
    assert ("link6", "hand") not in pairs  # a fixed joint and one that moves
    assert ("hand", "leftfinger") not in pairs
    assert ("link5", "link7") not in pairs  # the spheres overlap nearly always
    assert {("link0", "link6"), ("link1", "hand"), ("link3", "link5"), ("link2", "leftfinger")} <= pairs


def test_pairs_are_left_out_and_added_as_asked():
    layout, spheres = fitted("panda")
    pairs = self_pairs(layout, spheres)
    asked = self_pairs(layout, spheres, ignore=[(6, 0)], include=[(2, 1)])
    assert {*pairs} ^ {*asked} == {(0, 6), (1, 2)}
    assert asked == sorted(asked)


def test_links_without_shapes_do_not_keep_others_apart():
    layout, spheres = fitted("mobile_panda")  # x, y and yaw move the base; its link0 is fixed on top
    pairs = names(layout, spheres, self_pairs(layout, spheres))
    assert ("arm/base_link", "link0") not in pairs
    assert ("arm/base_link", "link1") not in pairs
    assert ("arm/base_link", "hand") in pairs
