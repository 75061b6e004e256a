# SPDX-License-Identifier: Apache-2.0
"""Collision with point clouds against the points themselves in float64, and clouds that change from plan to plan."""

import numpy as np
import pytest
import warp as wp
from arm_collisions import centres, evaluating, moving_spheres
from arms import arm_scene
from evaluating import Evaluating
from scipy.spatial import cKDTree
from small_scenes import layout_of

from warpmpc import Controller, SceneError, State, Task
from warpmpc.cost.resources.cloud import CloudVolume, PointClouds
from warpmpc.cost.stack import CostEvaluator, CostStack
from warpmpc.engine.protocol import TimeGrid
from warpmpc.kernels.geometry.volume import ABREAST, Volume, between_voxels, voxel_distance
from warpmpc.scene.model.trajectory import BatchSize
from warpmpc.scene.schema_bodies import Cloud

REGION = {"low": (-0.9, -0.9, -0.2), "high": (1.1, 0.9, 1.2)}
VOXEL = 0.025
HALF = 0.5 * np.sqrt(3.0) * VOXEL
"""Half of a voxel's diagonal: how far a point may be from the centre of its voxel [m]."""


def surfaces(seed: int, count: int = 20000, walls: int = 6) -> np.ndarray:
    """Points on walls and two balls, with 3 mm of noise."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(walls):
        corner, edges = rng.uniform([-0.7, -0.7, 0.0], [0.7, 0.7, 0.8]), rng.normal(0.0, 0.3, (2, 3))
        parts.append(corner + rng.uniform(0.0, 1.0, (count // 8, 2)) @ edges)
    for _ in range(2):
        ball = rng.normal(size=(count // 8, 3))
        ball *= rng.uniform(0.05, 0.15) / np.linalg.norm(ball, axis=1, keepdims=True)
        parts.append(rng.uniform([-0.7, -0.7, 0.0], [0.7, 0.7, 0.8]) + ball)
    return (np.concatenate(parts) + rng.normal(0.0, 0.003, ((walls + 2) * (count // 8), 3))).astype(np.float32)


def volume_of(points: np.ndarray, *, device: str = "cpu", **keys) -> CloudVolume:
    """The volume of a cloud in one environment."""
    volume = CloudVolume(Cloud(name="seen", **{**REGION, **keys}), envs=1, device=device)
    volume.show([points])
    volume.upload()
    volume.launch()
    return volume


def inside(points: np.ndarray, volume: CloudVolume) -> np.ndarray:
    """Voxels (x, y, z) of the points that are within the volume ``[n, 3]``."""
    size = volume.distance.shape[:0:-1]
    with np.errstate(invalid="ignore"):
        place = np.floor((points.astype(np.float64) - REGION["low"]) / VOXEL)
    return place[((place >= 0) & (place < size)).all(axis=1)].astype(int)


@pytest.mark.parametrize("reach", [0.05, 0.15, 0.4])
@pytest.mark.parametrize("seed", range(3))
def test_the_volume_is_the_exact_distance_between_voxels_up_to_its_reach(seed, reach, device):
    points = surfaces(seed, 800)
    volume = volume_of(points, device=device, reach=reach)
    cells = np.indices(volume.distance.shape[1:]).reshape(3, -1).T[:, ::-1]
    exact = VOXEL * cKDTree(inside(points, volume)).query(cells)[0]
    cap = (round(reach / VOXEL) + 1) * VOXEL
    np.testing.assert_allclose(volume.distance.ravel(), np.minimum(exact, cap), atol=1e-6)


def test_new_points_replace_the_old_ones_and_none_leave_it_empty(device):
    volume = volume_of(surfaces(0, 4000), device=device)
    first = volume.distance
    volume.show([surfaces(1, 800)])
    volume.upload()
    volume.launch()
    np.testing.assert_array_equal(volume.distance, volume_of(surfaces(1, 800), device=device).distance)
    volume.show([surfaces(0, 4000)])
    volume.upload()
    volume.launch()
    volume.launch()  # nothing is new
    np.testing.assert_array_equal(volume.distance, first)
    volume.show([np.zeros((0, 3), dtype=np.float32)])
    volume.upload()
    volume.launch()
    assert (volume.distance > 0.15).all()


def test_points_that_are_outside_or_not_finite_are_dropped(device):
    points = surfaces(0, 800)
    bad = np.full((7, 3), 0.3, dtype=np.float32)
    bad[[0, 1, 2], [0, 1, 2]] = np.nan, np.inf, -np.inf
    bad[3:] = [[1e30, 0, 0], [0, -5, 0], [0, 0, 1.3], [-0.91, 0, 0]]
    mixed = np.concatenate([bad[:4], points, bad[4:]])
    np.testing.assert_array_equal(volume_of(mixed, device=device).distance, volume_of(points, device=device).distance)


def test_what_lies_behind_a_point_counts_as_filled_if_wanted(device):
    point = np.array([[0.4, 0.0, 0.5]], dtype=np.float32)
    volume = volume_of(point, device=device, eye=(-0.6, 0.0, 0.5), behind=0.1)
    filled = np.argwhere(volume.distance[0] == 0.0)[:, ::-1]
    centre = np.array(REGION["low"]) + (filled + 0.5) * VOXEL
    assert len(filled) == 5
    assert centre[:, 0].min() == pytest.approx(0.4, abs=VOXEL)
    assert centre[:, 0].max() == pytest.approx(0.5, abs=VOXEL)
    assert np.abs(centre[:, 1:] - [0.0, 0.5]).max() <= VOXEL


def test_nothing_is_seen_through_a_wall_that_has_been_seen(device):
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 121), np.linspace(-0.3, 0.3, 121))  # 5 points of a row in each voxel
    wall = np.stack([np.full(x.size, 0.2), x.ravel(), 0.5 + y.ravel()], axis=1).astype(np.float32)
    eye, deep = np.array([-0.8, 0.1, 0.9]), 0.2
    volume = volume_of(wall, device=device, eye=tuple(eye), behind=deep)
    place = np.random.default_rng(0).integers(5, 116, (4000, 2))
    seen = wall.reshape(121, 121, 3)[place[:, 0], place[:, 1]].astype(float)
    ray = (seen - eye) / np.linalg.norm(seen - eye, axis=1, keepdims=True)
    behind = seen + np.random.default_rng(1).uniform(0.0, deep - VOXEL, (4000, 1)) * ray
    i, j, k = np.floor((behind - REGION["low"]) / VOXEL).astype(int).T
    distance = volume.distance[0][k, j, i]
    assert (distance == 0.0).mean() > 0.9
    assert distance.max() <= 1.01 * VOXEL  # no way through


def term(**keys) -> dict:
    return {"term": "cloud_collision", "margin": 0.05, **keys}


def seen_by(seed: int, points: np.ndarray, *, device: str, **keys):
    """A Panda in random postures near a cloud."""
    j = evaluating("panda", term(**keys), seed, device=device, cloud=[{"name": "seen", **REGION, "reach": 0.3}])
    j.task["seen"] = points
    j.observe()
    return j


def nearest(j, points: np.ndarray) -> np.ndarray:
    """Least distance of a moving link's sphere from points ``[T, W]``."""
    spheres = moving_spheres(j)
    at = centres(j, spheres)[1:]
    return (cKDTree(points.astype(np.float64)).query(at)[0] - spheres.radius.astype(np.float64)).min(axis=2)


@wp.kernel
def look_kernel(volume: Volume, at: wp.array[wp.vec3], nearest: wp.array[float], linear: wp.array[float]):
    i = wp.tid()
    nearest[i] = voxel_distance(volume, 0, at[i])
    linear[i] = between_voxels(volume, 0, at[i])


@pytest.mark.parametrize("seed", range(5))
def test_distances_are_those_of_the_points_but_for_the_voxels(seed, device):
    points, rng = surfaces(seed), np.random.default_rng(seed + 100)
    at = points[rng.integers(len(points), size=20000)] + rng.normal(0.0, 0.06, (20000, 3))
    at = at[((at > np.array(REGION["low"]) + VOXEL) & (at < np.array(REGION["high"]) - VOXEL)).all(axis=1)]
    kept = points[((points > REGION["low"]) & (points < REGION["high"])).all(axis=1)].astype(np.float64)
    true = cKDTree(kept).query(at)[0]
    at, true = at[(true > 0.015) & (true < 0.09)], true[(true > 0.015) & (true < 0.09)]
    places = wp.array(at, dtype=wp.vec3, device=device)
    found = [wp.zeros(len(at), dtype=float, device=device) for _ in range(2)]
    volume = volume_of(points, device=device).work.volume
    wp.launch(look_kernel, len(at), [volume, places, *found], device=device)
    nearest, linear = (f.numpy() - true for f in found)
    # the point and the place are both at most half a diagonal from where they are taken to be
    assert np.abs(nearest).max() < 2.0 * HALF
    # the place is exact, but for the bend of distances between voxels
    assert linear.max() < 1.1 * HALF
    assert np.quantile(linear, 0.999) < HALF
    assert np.quantile(nearest, 0.99) < HALF
    assert np.quantile(np.abs(linear), 0.95) < np.quantile(np.abs(nearest), 0.95)


@pytest.mark.parametrize("lookup", ["nearest", "linear"])
@pytest.mark.parametrize("seed", range(3))
def test_the_cost_is_the_least_distance_of_a_links_sphere(seed, lookup, device):
    points = surfaces(seed, walls=1)
    found = 0.05 - seen_by(seed, points, device=device, lookup=lookup, allowance=0.0).cost()[0]
    careful = 0.05 - seen_by(seed, points, device=device, lookup=lookup).cost()[0]
    true = np.minimum(nearest(j_of(seed, device), points), 0.05)
    clear = true > 0.0
    assert clear.sum() > 5
    assert (~clear).sum() > 5
    assert np.abs(found - true)[clear].max() < (2.0 if lookup == "nearest" else 1.3) * HALF
    assert (careful[clear] <= true[clear] + (HALF if lookup == "nearest" else 0.003)).all()


def j_of(seed: int, device: str):
    """The same postures without a cloud."""
    return seen_by(seed, np.zeros((0, 3)), device=device)


def test_the_binary_cost_is_one_where_the_distance_cost_is_not_zero(device):
    points = surfaces(0, walls=1)
    distance, binary = (seen_by(0, points, device=device, form=form).cost()[0] for form in ("distance", "binary"))
    np.testing.assert_array_equal(binary, distance > 0.0)
    assert 0.0 < binary.mean() < 1.0


def test_no_points_cost_nothing(device):
    np.testing.assert_array_equal(seen_by(0, np.zeros((0, 3)), device=device).cost(), 0.0)
    np.testing.assert_array_equal(seen_by(0, np.full((9, 3), np.nan), device=device).cost(), 0.0)


def planned_scene(samples: int = 37, **keys):
    drive = {"mode": "acceleration", "damping": 100.0, "limit": 10.0}
    robot = {**arm_scene("panda").robot[0].model_dump(mode="json"), "drive": drive}
    costs = [term(name=f"{lookup}_{form}", lookup=lookup, form=form)
             for lookup in ("nearest", "linear") for form in ("distance", "binary")]  # fmt: skip
    return arm_scene(
        "panda",
        robot=[robot],
        cost=[*costs, {"term": "joint_velocity"}],
        cloud=[{"name": "seen", **REGION, "reach": 0.25}],
        planner={"samples": samples, "horizon": 11, "noise": {"sigma": 4.0}, **keys},
    )


@pytest.mark.parametrize("seed", range(3))
def test_baked_source_costs_what_the_function_says(seed, device):
    mpc = Controller(planned_scene(), engine="kinematic", device=device, envs=2, seed=seed)
    mpc.task["seen"] = [surfaces(seed), surfaces(seed + 10, 8000)]
    layout, rng = mpc.layout, np.random.default_rng(seed)
    q = layout.joint_q + rng.normal(0.0, 0.3, (2, layout.nq))
    for _ in range(3):
        mpc.step(State(q, np.zeros((2, layout.nv))))
    engine, shape = mpc.engine, mpc.shape
    assert not engine.records
    out = engine.rollouts(range(shape.worlds))
    whole = BatchSize(2, shape.samples, 1, shape.horizon)
    evaluator = CostEvaluator(mpc.costs, out, out.control, engine.state, whole, TimeGrid.of(mpc.scene).t)
    evaluator.launch()
    weight = mpc.plan_step.grid.discount
    expected = (evaluator.cost.numpy() * weight[None, :, None]).sum(axis=1)
    found = engine.total.numpy()
    assert (expected[:4].max(axis=1) > 0.0).all()
    np.testing.assert_allclose(found[1::2][:1], expected[1::2][:1], atol=2.0 * weight.max())  # a step at the border
    for distances in (0, 2):
        # a sphere at the border between two voxels may be in either of them
        off = np.abs(found[distances] - expected[distances])
        assert np.median(off) < 1e-5
        assert (off > 1e-3 * (1.0 + expected[distances])).mean() < (0.05 if distances == 0 else 0.0 + 1e-9)


def test_a_cloud_changes_between_plans_without_a_new_graph(device):
    mpc = Controller(planned_scene(), engine="kinematic", device=device)
    state = State.start(mpc.layout)
    terms = []
    for points in (np.zeros((0, 3)), surfaces(0), surfaces(0)[:0], surfaces(0), surfaces(3)):
        mpc.task["seen"] = points
        mpc.step(state)
        terms.append(mpc.info.terms["linear_distance"])
    again = Controller(planned_scene(), engine="kinematic", device=device)
    again.task["seen"] = surfaces(3)
    volumes = []
    for controller in (mpc, again):
        controller.step(state)
        volumes.append(controller.costs.resources.get(PointClouds).volumes["seen"].distance)
    np.testing.assert_array_equal(*volumes)
    assert terms[0] == terms[2] == 0.0
    assert terms[1] != 0.0


def test_each_environment_sees_its_own_points(device):
    j = evaluating_two(device)
    j.task["seen"] = [surfaces(0), np.zeros((0, 3))]
    j.observe()
    volume = j.stack.resources.get(PointClouds).volumes["seen"].distance
    assert (volume[0] == 0.0).any()
    assert (volume[1] > 0.15).all()
    j.task.see("seen", surfaces(1), e=1)
    j.observe()
    both = j.stack.resources.get(PointClouds).volumes["seen"].distance
    np.testing.assert_array_equal(both[0], volume[0])
    assert (both[1] == 0.0).any()


def evaluating_two(device: str):
    return Evaluating(planned_scene(), BatchSize(2, 4, 1, 4), device=device)


@pytest.mark.parametrize("wrong", [np.zeros((3, 2)), np.zeros(3), np.zeros((2, 3, 3)), "points", 5.0, [[1, 2, 3], [4]]])
def test_wrong_shapes_are_one_clear_error(wrong):
    task = Task(planned_scene())
    with pytest.raises(ValueError, match=r"cloud of points \[n, 3\]"):
        task["seen"] = wrong


def test_more_points_than_the_capacity_are_an_error():
    task = Task(planned_scene())
    with pytest.raises(ValueError, match="capacity for 50000 points"):
        task["seen"] = np.zeros((50001, 3))


@pytest.mark.parametrize(
    ("changes", "key", "message"),
    [
        ({"cloud": ()}, "cost.cloud_collision.cloud", "give it a"),
        ({"cost": [term(cloud="sene")]}, "cost.cloud_collision.cloud", "no such cloud"),
        ({"cost": [term(margin=0.3)]}, "cloud.seen.reach", "reach is shorter"),
    ],
)
def test_mistakes_are_told_with_their_key(changes, key, message):
    scene = arm_scene("panda", **{"cost": [term()], "cloud": [{"name": "seen", **REGION, "reach": 0.3}], **changes})
    with pytest.raises(SceneError, match=message) as error:
        CostStack(scene, layout_of(scene), Task(scene))
    assert error.value.key == key


def test_rows_of_a_volume_suit_the_kernels():
    assert volume_of(np.zeros((0, 3), np.float32), high=(0.31, 0.9, 1.2)).distance.shape[3] % ABREAST == 0
