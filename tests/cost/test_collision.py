# SPDX-License-Identifier: Apache-2.0
"""Collision terms against float64 by brute force: every sphere, every pair, every obstacle, nothing left out."""

import itertools

import numpy as np
import pytest
import trimesh
import warp as wp
from arm_collisions import SHAPE, centres, evaluating, moving_spheres, place
from arms import FOLDED, HOME, arm_scene
from evaluating import Evaluating
from scipy.spatial.transform import Rotation
from small_scenes import layout_of

from warpmpc import SceneError, Task
from warpmpc.cost.stack import CostStack
from warpmpc.scene.model.pairs import self_pairs
from warpmpc.scene.model.spheres import fit_spheres

TURNED = (0.1, -0.5, 0.2, 0.8)
OBSTACLES = [
    {"name": "block", "shape": "box", "size": (0.2, 0.3, 0.4), "position": (0.5, 0.1, 0.4), "rotation": TURNED},
    {"name": "ball", "shape": "sphere", "size": 0.15, "position": (-0.3, 0.4, 0.6)},
    {"name": "post", "shape": "cylinder", "size": (0.08, 0.9), "position": (0.1, -0.5, 0.5), "rotation": TURNED},
    {"name": "bar", "shape": "capsule", "size": (0.05, 0.6), "position": (-0.4, -0.3, 0.5), "rotation": TURNED},
]


def deepest(j: Evaluating, spheres, pairs) -> np.ndarray:
    """Deepest penetration of any two spheres of paired groups ``[T, W]``."""
    at, radius, groups = centres(j, spheres)[1:], spheres.radius.astype(np.float64), spheres.groups
    depth = np.full(at.shape[:2], -np.inf)
    for a, b in pairs:
        first, second = (range(groups[g].first, groups[g].first + groups[g].count) for g in (a, b))
        for i, k in itertools.product(first, second):
            depth = np.maximum(depth, radius[i] + radius[k] - np.linalg.norm(at[:, :, i] - at[:, :, k], axis=-1))
    return depth


@pytest.mark.parametrize("name", ["panda", "ur10", "mobile_panda"])
def test_self_collision_is_the_deepest_penetration(name, device):
    j = evaluating(name, {"term": "self_collision", "margin": 0.03}, device=device)
    spheres = fit_spheres(j.layout, range(j.layout.nb))
    wanted = np.maximum(0.03 + deepest(j, spheres, self_pairs(j.layout, spheres, margin=0.03)), 0.0)
    np.testing.assert_allclose(j.cost()[0], wanted, atol=2e-6)
    assert (wanted > 0.0).any()
    assert (wanted == 0.0).any()


def distance(obstacle: dict, points: np.ndarray) -> np.ndarray:
    """Signed distance of points ``[..., 3]`` from an obstacle in float64."""
    x, y, z, w = obstacle.get("rotation", (0.0, 0.0, 0.0, 1.0))
    shape = points.shape[:-1]
    p = Rotation.from_quat([x, y, z, w]).inv().apply(points.reshape(-1, 3) - np.array(obstacle["position"]))
    size = np.atleast_1d(obstacle["size"])
    match obstacle["shape"]:
        case "sphere":
            d = np.linalg.norm(p, axis=1) - size[0]
        case "capsule":
            p[:, 2] -= np.clip(p[:, 2], -0.5 * size[1], 0.5 * size[1])
            d = np.linalg.norm(p, axis=1) - size[0]
        case "cylinder":
            q = np.stack([np.hypot(p[:, 0], p[:, 1]) - size[0], np.abs(p[:, 2]) - 0.5 * size[1]], axis=1)
            d = np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)
        case _:
            q = np.abs(p) - 0.5 * size
            d = np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)
    return d.reshape(shape)


def nearest(j: Evaluating, obstacles=OBSTACLES, share: float = 0.0) -> np.ndarray:
    """Least distance of any moving link's sphere, so far back on the straight way from the step before ``[T, W]``."""
    spheres = moving_spheres(j)
    at = centres(j, spheres)
    at = (1.0 - share) * at[1:] + share * at[:-1]
    return np.min([distance(o, at) - spheres.radius.astype(np.float64) for o in obstacles], axis=(0, 3))


@pytest.mark.parametrize("name", ["panda", "ur10", "mobile_panda"])
def test_world_collision_is_the_least_distance(name, device):
    j = evaluating(name, {"term": "world_collision", "margin": 0.1}, device=device, obstacle=OBSTACLES)
    wanted = np.maximum(0.1 - nearest(j), 0.0)
    np.testing.assert_allclose(j.cost()[0], wanted, atol=3e-6)
    assert (wanted > 0.0).any()


def test_the_binary_cost_is_one_where_anything_is_too_close(device):
    cost = {"term": "world_collision", "form": "binary", "margin": 0.02}
    j = evaluating("panda", cost, device=device, obstacle=OBSTACLES)
    least = nearest(j)
    assert (np.abs(least - 0.02) > 1e-5).all()
    np.testing.assert_array_equal(j.cost()[0], least < 0.02)
    assert 0.0 < (least < 0.02).mean() < 1.0


def test_the_swept_distance_is_that_of_the_whole_way(device):
    cost = {"term": "world_collision", "margin": 0.1, "swept": True}
    j = evaluating("panda", cost, device=device, pull=0.3, obstacle=OBSTACLES)
    dense = np.maximum(0.1 - np.min([nearest(j, share=share) for share in np.linspace(0.0, 1.0, 201)], axis=0), 0.0)
    found = j.cost()[0]
    radius = moving_spheres(j).radius.max()
    assert (found <= dense + 2e-3).all()  # the reference looks at every 5 mm or so
    assert (found >= dense - radius / 8.0 - 1e-5).all()
    assert (found > np.maximum(0.1 - nearest(j), 0.0) + 0.02).any()


def test_a_thin_wall_is_not_jumped_over(device):
    wall = {"name": "wall", "shape": "box", "size": (2.0, 0.01, 2.0), "position": (0.0, 0.55, 0.5)}
    costs = [{"term": "world_collision", "form": "binary", "swept": s} for s in (False, True)]
    found = []
    for cost in costs:
        # the first axis turns by 0.5 rad in a step of 0.2 s, its greatest speed being 2.5 rad/s
        j = evaluating("panda", {**cost, "links": ["panda_link7"]}, device=device, obstacle=[wall])
        q = np.tile([0.0, 0.9, 0.0, -1.2, 0.0, 2.0, 0.0], (5, SHAPE.worlds, 1))
        q[:, :, 0] = np.linspace(0.2, 0.9, SHAPE.worlds) + 0.5 * np.arange(5)[:, None]
        place(j, q)
        link = j.trajectory.body_q.numpy()[:, :, j.layout.body_name.index("arm/panda_link7"), 1]
        assert ((link[:1] < 0.5) & (link[-1:] > 0.6)).any()
        found.append((j.cost()[0], (link[:-1] < 0.55) & (link[1:] > 0.55)))
    (at_ends, _), (swept, crossed) = found
    assert crossed.any()
    assert (swept[crossed] == 1.0).all()
    assert (at_ends[crossed] == 0.0).any()


@pytest.mark.parametrize("cost", [{"term": "self_collision"}, {"term": "world_collision", "swept": True}])
def test_culling_changes_nothing(cost, device):
    j = evaluating("panda", {**cost, "margin": 0.05}, device=device, obstacle=OBSTACLES)
    culled = j.cost()
    params = j.stack.terms[0][1]
    params.spheres.bound_radius = wp.full(len(params.spheres.bound_radius), 100.0, dtype=float, device=device)
    j.stack.params.p0 = params
    np.testing.assert_array_equal(culled, j.cost())


def test_a_folded_arm_collides_with_itself_and_one_at_home_does_not(device):
    j = evaluating("panda_meshes", {"term": "self_collision"}, device=device)
    fingers = [0.02, 0.02]
    place(j, [*HOME, *fingers])
    np.testing.assert_array_equal(j.cost(), 0.0)
    place(j, [*FOLDED, *fingers])
    assert (j.cost() > 0.01).all()


def test_meshes_and_the_ground_are_obstacles(tmp_path, device):
    trimesh.creation.icosphere(3, radius=0.2).export(tmp_path / "rock.stl")
    rock = {"name": "rock", "shape": "mesh", "mesh": str(tmp_path / "rock.stl"), "position": (0.4, 0.0, 0.5)}
    ball = {"name": "ball", "shape": "sphere", "size": 0.2, "position": (0.4, 0.0, 0.5)}
    cost = {"term": "world_collision", "margin": 0.3}
    mesh, sphere = (evaluating("panda", cost, device=device, obstacle=[o]).cost() for o in (rock, ball))
    np.testing.assert_allclose(mesh, sphere, atol=3e-3)
    assert (mesh > 0.3).any()  # inside, too
    floor = evaluating("panda", {**cost, "against": "ground"}, device=device, ground={"height": 0.1})
    spheres = moving_spheres(floor)
    height = (centres(floor, spheres)[1:, :, :, 2] - spheres.radius).min(axis=2) - 0.1
    np.testing.assert_allclose(floor.cost()[0], np.maximum(0.3 - height, 0.0), atol=3e-6)


def test_an_obstacle_that_moves_with_the_task_is_seen_where_it_is(device):
    block = {**OBSTACLES[0], "movable": True}
    j = evaluating("panda", {"term": "world_collision", "margin": 0.1}, device=device, obstacle=[OBSTACLES[1], block])
    np.testing.assert_allclose(j.cost()[0], np.maximum(0.1 - nearest(j, OBSTACLES[:2]), 0.0), atol=3e-6)
    moved = {**block, "position": (0.2, -0.3, 0.7), "rotation": (0.0, 0.0, 0.6, 0.8)}
    j.task["block"] = [*moved["position"], *moved["rotation"]]
    j.state.pose.assign(j.task.block[:, :14].reshape(1, 2, 7))
    np.testing.assert_allclose(j.cost()[0], np.maximum(0.1 - nearest(j, [OBSTACLES[1], moved]), 0.0), atol=3e-6)


def test_given_spheres_replace_those_of_a_link(device):
    spheres = {f"panda_link{i}": [] for i in range(8)} | {"panda_link7": [(0.0, 0.0, 0.1, 0.07)]}
    robot = [{**arm_scene("panda").robot[0].model_dump(mode="json"), "spheres": spheres}]
    j = evaluating(
        "panda", {"term": "world_collision", "margin": 0.5}, device=device, obstacle=OBSTACLES[1:2], robot=robot
    )
    link = j.trajectory.body_q.numpy()[1:, :, j.layout.body_name.index("arm/panda_link7")].astype(np.float64)
    tip = link[..., :3] + Rotation.from_quat(link[..., 3:].reshape(-1, 4)).apply([0, 0, 0.1]).reshape(
        link[..., :3].shape
    )
    np.testing.assert_allclose(j.cost()[0], np.maximum(0.57 - distance(OBSTACLES[1], tip), 0.0), atol=3e-6)


@pytest.mark.parametrize(
    ("cost", "key", "message"),
    [
        ({"term": "self_collision", "of": "leg"}, "cost.self_collision.of", "no such robot"),
        (
            {"term": "self_collision", "ignore": [["panda_link0", "thumb"]]},
            "cost.self_collision.ignore",
            "no such link",
        ),
        ({"term": "self_collision", "include": [["panda_link2"] * 2]}, "cost.self_collision.include", "with itself"),
        ({"term": "world_collision", "links": "thumb"}, "cost.world_collision.links", "no such link"),
        ({"term": "world_collision", "against": ["wal"]}, "cost.world_collision.against", "no such obstacle"),
        ({"term": "world_collision", "against": "arm"}, "cost.world_collision.against", "no obstacle"),
        ({"term": "world_collision", "form": "soft"}, "cost.world_collision.form", "wrong value"),
        ({"term": "world_collision", "links": "panda_link8"}, "cost.world_collision", "give them spheres"),
        ({"term": "obstacle_clearance", "of": "ball"}, "cost.obstacle_clearance", "take world_collision"),
    ],
)
def test_mistakes_are_told_with_their_key(cost, key, message):
    moving = {**OBSTACLES[1], "movable": True}
    scene = arm_scene("panda_meshes" if cost.get("links") == "panda_link8" else "panda", cost=[cost], obstacle=[moving])
    with pytest.raises(SceneError, match=message) as error:
        CostStack(scene, layout_of(scene), Task(scene))
    assert error.value.key == key
