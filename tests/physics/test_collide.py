# SPDX-License-Identifier: Apache-2.0
"""Contacts of the engine `fused` are MuJoCo C's, for 16, 8 or one pair at once."""

import functools
import os

import numpy as np
import pytest
from collide_world import MARGIN, Poses, compare, make_kernel, mesh_tables, model, nanoseconds, ours, theirs

from warpmpc.bake.number import native_lanes

KINDS = (
    "plane_sphere", "plane_capsule", "plane_box", "plane_cylinder", "plane_ellipsoid", "sphere_sphere",
    "sphere_capsule", "capsule_capsule", "sphere_cylinder", "sphere_box", "capsule_box", "box_box",
)  # fmt: skip
CONVEX = (
    "sphere_ellipsoid", "capsule_ellipsoid", "capsule_cylinder", "ellipsoid_ellipsoid", "ellipsoid_cylinder",
    "ellipsoid_box", "cylinder_cylinder", "cylinder_box",
)  # fmt: skip
FILES = ("collide_box.h", "collide_primitive.h")
LANES = native_lanes()


def matrices(q: np.ndarray) -> np.ndarray:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] (w, x, y, z), normalized here."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], axis=1).reshape(-1, 3, 3)  # fmt: skip


def tilted(rng, n: int, angle) -> np.ndarray:
    """Rotations [N, 3, 3] by some angle [rad] about random axes."""
    axis = rng.normal(size=(n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = 0.5 * np.broadcast_to(angle, n)[:, None]
    return matrices(np.concatenate([np.cos(half), axis * np.sin(half)], axis=1))


QUARTERS = np.array([
    [[s if j == p[i] else 0.0 for j in range(3)] for i, s in enumerate(signs)]
    for p in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2))
    for signs in np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).T.reshape(-1, 3)
])  # fmt: skip
QUARTERS = QUARTERS[np.linalg.det(QUARTERS) > 0]
"""The 24 rotations that map axes to axes."""


def draw(family: str, n: int, seed: int = 0) -> Poses:
    """Pairs that often touch.

    Args:
        family: `any`: all directions and distances; `deep`: nearly the same centre; `unlike`: one is 10 to 50 times
            larger; `parallel`: axes along axes, as exact as floats are; `touching`: the same, a face of one at a face
            of the other; `stack`: the same with equal boxes, edges on edges; `nearly`: as `touching`, turned by 1e-4 to
            1e-2 rad; `slide`: turned about one common axis.
        n: How many.
        seed: Of the drawing.
    """
    rng = np.random.default_rng([seed, *family.encode()])
    size = rng.uniform(0.05, 0.4, (n, 2, 3))
    base = matrices(rng.normal(size=(n, 4)))
    away = rng.normal(size=(n, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    far = 2.4 * size.mean(axis=(1, 2))[:, None] * rng.uniform(0, 1, (n, 1))
    turn = matrices(rng.normal(size=(n, 4)))
    if family == "deep":
        far = 0.3 * far
    if family == "unlike":
        size[:, 1] *= rng.uniform(10, 50, (n, 1))
        far = 1.2 * size[:, 1].mean(axis=1)[:, None] * rng.uniform(0, 1, (n, 1))
    if family in ("parallel", "touching", "nearly", "slide", "stack"):
        turn = QUARTERS[rng.integers(24, size=n)]
        far = 1.5 * far
    if family == "slide":
        a = rng.uniform(-np.pi, np.pi, n)
        c, s, o, e = np.cos(a), np.sin(a), np.zeros(n), np.ones(n)
        turn = np.stack([c, -s, o, s, c, o, o, o, e], axis=1).reshape(n, 3, 3)
    if family == "nearly":
        turn = turn @ tilted(rng, n, 10 ** rng.uniform(-4, -2, n))
    local = away * far
    if family in ("touching", "nearly", "slide"):
        reach = size[:, 0] + np.einsum("nij,nj->ni", np.abs(turn), size[:, 1])
        k = rng.integers(3, size=n) if family != "slide" else np.full(n, 2)
        i = np.arange(n)
        local = rng.uniform(-0.7, 0.7, (n, 3)) * reach
        local[i, k] = rng.choice([-1, 1], n) * (reach[i, k] - rng.choice([1e-4, 1e-3, 1e-2], n))
    if family == "stack":
        turn = np.broadcast_to(np.eye(3), (n, 3, 3))
        size[:, 1] = size[:, 0]
        local = np.zeros((n, 3))
        local[np.arange(n), rng.integers(3, size=n)] = 1
        local *= 2 * size[:, 0] - rng.choice([1e-5, 1e-3], n)[:, None]
    origin = rng.uniform(-1, 1, (n, 3))
    pos = np.stack([origin, origin + np.einsum("nij,nj->ni", base, local)], axis=1)
    return Poses(pos, np.stack([base, base @ turn], axis=1).reshape(n, 2, 9), size)


def shallow(kind: str, n: int, low: float = 0.0, seed: int = 0) -> Poses:
    """Pairs that overlap by `low` to 5 mm, in all directions: moved along the normal of MuJoCo's deepest contact."""
    rng, mj = np.random.default_rng([seed, 7]), model(tuple(kind.split("_")))
    poses = draw("any", 2 * n, seed)
    depth = rng.uniform(low, 5e-3, 2 * n)
    for k in range(3):
        found = theirs(mj, poses)
        kept = np.array([i for i, x in enumerate(found) if len(x)])
        poses, depth = poses.take(kept), depth[kept]
        deepest = np.array([found[i][found[i][:, 0].argmin()] for i in kept])
        poses.pos[:, 1] -= deepest[:, 4:7] * (deepest[:, :1] + (depth[:, None] if k == 2 else 1e-3))
    return poses.take(slice(0, n))


@pytest.fixture(scope="module", params=sorted({LANES, 8, 1}))
def kernel(request):
    """The functions for the lanes of this processor, for 8 and for one as on a GPU."""
    return make_kernel(FILES, KINDS, lanes=request.param), request.param


@functools.cache
def expected(kind: str, family: str, n: int, margin: bool):
    """Pairs of a family (`shallow`: down to MARGIN apart with a margin) and MuJoCo's contacts."""
    poses = shallow(kind, n, low=-0.75 * MARGIN * margin) if family == "shallow" else draw(family, n)
    return poses, theirs(model(tuple(kind.split("_")), MARGIN * margin), poses)


def agreement(kernel, kinds, kind: str, family: str, n: int, margin: bool = False):
    """How contacts agree on pairs of a family."""
    compiled, lanes = kernel
    poses, contacts = expected(kind, family, n, margin)
    found = compare(ours(compiled, kinds.index(kind), poses, lanes, int(margin)), contacts)
    print(f"\n{kind} {family} x{lanes}: {found}", end="")
    return found


@pytest.mark.parametrize("margin", [False, True])
@pytest.mark.parametrize("family", ["any", "deep", "unlike"])
@pytest.mark.parametrize("kind", KINDS)
def test_contacts_of_any_poses_are_mujocos(kernel, kind, family, margin):
    found = agreement(kernel, KINDS, kind, family, 600, margin)
    scale = 20.0 if family == "unlike" else 1.0
    assert found.touching > 200
    assert found.same > 0.997
    assert np.percentile(found.dist, 99) < 5e-6 * scale
    assert np.percentile(found.pos, 99) < 2e-5 * scale
    assert np.percentile(found.normal, 98) < 2e-4
    assert np.median(found.tangent) < 2e-6


@pytest.mark.parametrize("family", ["touching", "parallel", "slide", "nearly"])
@pytest.mark.parametrize("kind", KINDS)
def test_contacts_of_aligned_poses_are_mujocos(kernel, kind, family):
    found = agreement(kernel, KINDS, kind, family, 600)
    assert found.touching > 100
    # MuJoCo's capsule-box takes rounding of exactly parallel axes for a direction: one or two contacts by chance
    assert found.same > (0.8 if kind == "capsule_box" else 0.99)
    if kind == "plane_cylinder" and family in ("touching", "parallel"):
        return  # one that stands: MuJoCo's first point of the rim is where rounding points
    assert np.percentile(found.dist, 95) < 1e-6
    assert np.percentile(found.pos, 95) < 1e-4


def test_equal_boxes_on_each_other_touch_at_four_corners(kernel):
    # MuJoCo makes 4 to 8 contacts of them: where edges cross by rounding, it adds points along the edges
    compiled, lanes = kernel
    poses = draw("stack", 500)
    for x, y in zip(
        ours(compiled, KINDS.index("box_box"), poses, lanes), theirs(model(("box", "box")), poses), strict=True
    ):
        assert len(x) == 4
        gap = np.linalg.norm(x[:, None, 1:4] - y[None, :, 1:4], axis=-1)
        assert gap.min(axis=1).max() < 1e-5
        np.testing.assert_allclose(x[:, 0], y[gap.argmin(axis=1), 0], atol=1e-6)


@pytest.fixture(scope="module", params=sorted({LANES, 1}))
def convex(request):
    """The functions for pairs of convex shapes."""
    return make_kernel(("collide_convex.h",), CONVEX, lanes=request.param), request.param


@pytest.mark.parametrize("margin", [False, True])
@pytest.mark.parametrize("kind", CONVEX)
def test_convex_shapes_that_touch_have_mujocos_contact(convex, kind, margin):
    found = agreement(convex, CONVEX, kind, "shallow", 400, margin)
    assert found.touching > 300
    assert found.same > 0.999
    assert np.percentile(found.dist, 99) < 1e-4
    assert np.mean(found.normal < 1e-2) > 0.98
    assert np.percentile(found.pos, 95) < 2e-3


@pytest.mark.parametrize("family", ["any", "touching", "nearly"])
@pytest.mark.parametrize("kind", CONVEX)
def test_convex_shapes_deep_in_each_other_are_pushed_apart(convex, kind, family):
    found = agreement(convex, CONVEX, kind, family, 400)
    assert found.same > 0.99
    assert np.mean(found.dist < 1e-4) > 0.7


def test_a_poisoned_world_changes_no_bit_of_the_others(kernel, convex):
    for (compiled, lanes), kinds in ((kernel, KINDS), (convex, CONVEX)):
        for k in range(len(kinds)):
            poses = draw("any", 64)
            clean = ours(compiled, k, poses, lanes)
            poses.pos[3::7, 1, 0] = np.nan
            for i, (x, y) in enumerate(zip(ours(compiled, k, poses, lanes), clean, strict=True)):
                if i % 7 != 3:
                    np.testing.assert_array_equal(x, y)


WITH_MESH = ("plane_mesh", "sphere_mesh", "capsule_mesh", "ellipsoid_mesh", "cylinder_mesh", "box_mesh")
POINTS = np.random.default_rng(3).normal(size=(24, 3))
POINTS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True) * (0.25, 0.2, 0.12)
POINTS = np.concatenate(
    [POINTS, [(0.1 * np.cos(a), 0.1 * np.sin(a), -0.15) for a in (0.0, 1.1, 1.5, 2.7, 3.9, 4.6, 5.8)]]
)
MESH = f'<mesh name="mesh" vertex="{" ".join(f"{x:.5f}" for x in POINTS.ravel())}"/>'


@pytest.fixture(scope="module", params=sorted({LANES, 1}))
def meshes(request):
    """The functions for pairs with a mesh."""
    tables = mesh_tables(model(("box", "mesh"), asset=MESH))
    return make_kernel(("collide_convex.h",), WITH_MESH, lanes=request.param, tables=tables), request.param


@pytest.mark.parametrize("kind", WITH_MESH)
def test_a_convex_mesh_has_mujocos_contacts(meshes, kind):
    compiled, lanes = meshes
    mj = model(tuple(kind.split("_")), asset=MESH)
    poses = draw("any", 600)
    poses.size[:, 1] = mj.geom_size[1]
    if kind != "plane_mesh":
        for depth in (1e-3, 1e-3, 2e-3):
            found = theirs(mj, poses)
            kept = np.array([i for i, x in enumerate(found) if len(x)])
            poses = poses.take(kept)
            deepest = np.array([found[i][0] for i in kept])
            poses.pos[:, 1] -= deepest[:, 4:7] * (deepest[:, :1] + depth)
    found = compare(ours(compiled, WITH_MESH.index(kind), poses, lanes), theirs(mj, poses))
    print(f"\n{kind} x{lanes}: {found}; normals within 1e-2: {np.mean(found.normal < 1e-2):.4f}", end="")
    assert found.touching > 300
    assert found.same > 0.99
    assert np.percentile(found.dist, 98) < 1e-4
    assert np.mean(found.normal < 1e-2) > 0.95


@pytest.mark.skipif(
    "WARPMPC_SPEED" not in os.environ,
    reason="prints times: WARPMPC_SPEED=1 python -m pytest -s tests/physics/test_collide.py",
)
def test_time_of_a_call():
    for files, kinds, repeat in ((FILES, KINDS, 200), (("collide_convex.h",), CONVEX, 20)):
        compiled = make_kernel(files, kinds, lanes=LANES, speed=True)
        for k, kind in enumerate(kinds):
            poses = shallow(kind, 50 * LANES)
            twins = poses.take(np.repeat(np.arange(50), LANES))
            times = [nanoseconds(compiled, k, x, LANES, repeat) for x in (poses, twins)]
            print(kind, *(f"{t:.0f} ns, {p:.1f} puts" for t, p in times))
