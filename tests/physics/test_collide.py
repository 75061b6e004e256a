# SPDX-License-Identifier: Apache-2.0
"""Contacts of the engine `fused` are MuJoCo C's, for 16, 8 or one pair at once."""

import functools
import os

import numpy as np
import pytest
from collide_pairs import MESH, draw
from collide_world import MARGIN, Poses, compare, make_kernel, mesh_tables, model, nanoseconds, ours, theirs

from warpmpc.physics.runtime.bake import native_lanes

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
    return make_kernel(("shapes.h", "collide_convex.h"), CONVEX, lanes=request.param), request.param


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


@pytest.fixture(scope="module", params=sorted({LANES, 1}))
def meshes(request):
    """The functions for pairs with a mesh."""
    tables = mesh_tables(model(("box", "mesh"), asset=MESH))
    return make_kernel(("shapes.h", "collide_convex.h"), WITH_MESH, lanes=request.param, tables=tables), request.param


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
    for files, kinds, repeat in ((FILES, KINDS, 200), (("shapes.h", "collide_convex.h"), CONVEX, 20)):
        compiled = make_kernel(files, kinds, lanes=LANES, speed=True)
        for k, kind in enumerate(kinds):
            poses = shallow(kind, 50 * LANES)
            twins = poses.take(np.repeat(np.arange(50), LANES))
            times = [nanoseconds(compiled, k, x, LANES, repeat) for x in (poses, twins)]
            print(kind, *(f"{t:.0f} ns, {p:.1f} puts" for t, p in times))
