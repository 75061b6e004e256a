# SPDX-License-Identifier: Apache-2.0
"""Distance volumes of meshes against queries of the meshes themselves, and against exact distances."""

import numpy as np
import pytest
import trimesh
import warp as wp
from arms import arm_scene
from small_scenes import layout_of

from warpmpc import SceneError, Task
from warpmpc.cost.stack import CostStack
from warpmpc.kernels.geometry.volume import MeshVolumes, mesh_distance

REACH = 0.05
"""Margin of the terms here; the largest sphere's radius comes on top [m]."""


@wp.kernel
def compare_kernel(
    # inputs
    volumes: MeshVolumes,
    k: int,
    mesh: wp.uint64,
    at: wp.array[wp.vec3],
    # outputs
    read: wp.array[float],
    asked: wp.array[float],
):
    """One thread: what a volume says of one point, and what the mesh does."""
    i = wp.tid()
    read[i] = mesh_distance(volumes, k, at[i])
    found = wp.mesh_query_point_sign_normal(mesh, at[i], 10.0)
    asked[i] = found.sign * wp.length(at[i] - wp.mesh_eval_position(mesh, found.face, found.u, found.v))


def solids(folder):
    """Convex solids: edges and corners, round, and random ones."""
    rng = np.random.default_rng(4)
    out = {"block": trimesh.creation.box((0.3, 0.2, 0.1)), "rock": trimesh.creation.icosphere(4, radius=0.15)}
    out["shard"] = trimesh.convex.convex_hull(rng.normal(0.0, (0.1, 0.06, 0.08), (14, 3)))
    for name, solid in out.items():
        solid.export(folder / f"{name}.stl")
    return out


def stack_of(folder, device="cpu", **keys):
    """Terms of an arm among these solids, and its parameters."""
    places = {"block": (0.6, 0.0, 0.4), "rock": (-0.5, 0.3, 0.5), "shard": (0.0, 0.6, 0.5)}
    rows = [
        {"name": name, "shape": "mesh", "mesh": str(folder / f"{name}.stl"), "position": at}
        for name, at in places.items()
    ]
    rows.append({**rows[0], "name": "other", "position": (0.0, -0.6, 0.4)})
    cost = {"term": "world_collision", "margin": REACH, **keys}
    scene = arm_scene(
        "panda", cost=[cost], obstacle=rows, success={"conditions": {"term": "world_collision", "below": 1}}
    )
    stack = CostStack(scene, layout_of(scene), Task(scene), device=device)
    return stack, stack.terms[0][1]


@pytest.mark.parametrize("voxel", [None, 0.006])
def test_a_volume_says_what_queries_of_the_mesh_say(tmp_path, voxel, device):
    built = solids(tmp_path)
    stack, params = stack_of(tmp_path, device, **({"voxel": voxel} if voxel else {}))
    assert stack is not None
    index = params.mesh.numpy()
    assert index[0] == index[3]  # one volume for both
    edges, radius = params.volumes.voxel.numpy(), float(params.spheres.radius.numpy().max())
    for k, (name, solid) in enumerate(built.items()):
        rng, edge = np.random.default_rng(k), float(edges[index[k]])
        span = np.ptp(solid.vertices, axis=0)
        points = rng.uniform(-1.0, 1.0, (20000, 3)) * (0.5 * span.max() + 0.6)
        mesh = wp.Mesh(
            points=wp.array(solid.vertices.astype(np.float32), dtype=wp.vec3, device=device),
            indices=wp.array(solid.faces.astype(np.int32).ravel(), dtype=int, device=device),
        )
        at = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
        out = [wp.empty(len(points), dtype=float, device=device) for _ in range(2)]
        wp.launch(compare_kernel, len(points), [params.volumes, int(index[k]), mesh.id, at], out, device=device)
        read, asked = (a.numpy().astype(float) for a in out)
        near = asked < REACH + radius
        assert near.any()
        assert (asked < 0.0).any()
        error = read - asked
        # a convex function lies below what is drawn between its points, and the distance bends by 1/d off a corner
        assert error[near].min() > -1e-5, name
        assert error[near].max() < 0.5 * edge
        clear = near & (asked > 3.0 * edge)
        assert error[clear].max() < edge**2 / (3.0 * edge) * 0.5
        # beyond, never more than there is but for that, and never so little that a sphere costs something
        assert (error[~near] < 0.1 * edge).all()
        assert (read[~near] > REACH + radius - 0.5 * edge).all()


def test_voxels_that_are_too_small_are_told(tmp_path):
    solids(tmp_path)
    with pytest.raises(SceneError, match="take larger ones") as error:
        stack_of(tmp_path, voxel=2e-4)
    assert error.value.key == "cost.world_collision.voxel"
