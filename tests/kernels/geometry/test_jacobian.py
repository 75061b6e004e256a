# SPDX-License-Identifier: Apache-2.0
"""Jacobians against MuJoCo's and Pinocchio's, and manipulability against float64."""

import numpy as np
import pytest
import warp as wp
from jacobians import mujoco_jacobians
from needs import need
from scipy.spatial.transform import Rotation
from small_scenes import chain_scene, compiled, make_scene, random_state

from warpmpc.kernels.geometry.jacobian import Chain, jacobian_column, manipulability_of, solve_damped
from warpmpc.kernels.geometry.kinematics import forward_kinematics_kernel
from warpmpc.scene.model.assets import resolve_asset
from warpmpc.scene.model.joints import chain, chain_axes, joint_table
from warpmpc.scene.model.layout import Layout

wp.set_module_options({"enable_backward": False})

ROBOTS = {
    "panda": ("package://example-robot-data/robots/panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "ur5": ("package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf", "tool0"),
    "pr2": ("package://example-robot-data/robots/pr2_description/urdf/pr2.urdf", "r_gripper_tool_frame"),
    "mobile": ("assets/mobile_panda.xml", "panda_hand"),
}
"""Robots with the link that is looked at: two arms, one on a lift, one on a base of two slides and a hinge."""


def scene_of(asset: str):
    robot = {"name": "robot", "asset": asset, "position": (0.3, -0.2, 0.9), "rotation": (0.2, 0.4, -0.1, 0.7)}
    return make_scene(robot=[{**robot, "drive": {"damping": 1.0, "limit": 1.0}}])


@wp.kernel
def jacobian_kernel(
    # inputs
    links: Chain,
    about: wp.array2d[wp.vec3],  # [T, W]
    joint_q: wp.array3d[float],
    body_q: wp.array3d[wp.transform],
    # outputs
    jacobian: wp.array4d[float],  # [T, W, 6, n]
    measure: wp.array2d[float],  # [T, W]
):
    """One thread: the Jacobian and manipulability of a chain in one world at one step."""
    t, w = wp.tid()
    for i in range(links.column.shape[0]):
        column = jacobian_column(links, i, about[t, w], joint_q, body_q, t, w)
        for r in range(6):
            jacobian[t, w, r, i] = column[r]
    measure[t, w] = manipulability_of(links, about[t, w], joint_q, body_q, t, w)


def evaluate(layout: Layout, body: int, q: np.ndarray, *, columns=None, away: float = 0.0, device: str = "cpu"):
    """Body poses, Jacobians about a point away from a body's origin, and manipulability at coordinates [T, W, nq]."""
    shape = q.shape[:2]
    columns = chain_axes(layout, body) if columns is None else columns
    joint_q = wp.array(q, dtype=float, device=device)
    joint_qd = wp.zeros((*shape, layout.nv), dtype=float, device=device)
    body_q = wp.zeros((*shape, layout.nb), dtype=wp.transform, device=device)
    body_qd = wp.zeros((*shape, layout.nb), dtype=wp.spatial_vector, device=device)
    table = joint_table(layout, device)
    wp.launch(forward_kinematics_kernel, shape, [table, joint_q, joint_qd], [body_q, body_qd], device=device)
    poses = body_q.numpy()
    about = wp.array(poses[:, :, body, :3] + away, dtype=wp.vec3, device=device)
    jacobian = wp.zeros((*shape, 6, len(columns)), dtype=float, device=device)
    measure = wp.zeros(shape, dtype=float, device=device)
    links = chain(layout, body, columns, device)
    wp.launch(jacobian_kernel, shape, [links, about, joint_q, body_q], [jacobian, measure], device=device)
    return poses, jacobian.numpy().astype(np.float64), measure.numpy().astype(np.float64)


def postures(layout: Layout, *, seed: int, shape=(2, 5)) -> np.ndarray:
    """Random joint coordinates [T, W, nq]."""
    count = int(np.prod(shape))
    return np.stack([random_state(layout, 1000 * seed + i)[0] for i in range(count)]).reshape(*shape, -1)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", ROBOTS)
def test_jacobians_are_mujocos(name, seed, device):
    asset, link = ROBOTS[name]
    scene = scene_of(asset)
    layout = compiled(scene).layout
    body = layout.body_name.index(f"robot/{link}")
    q = postures(layout, seed=seed)
    _, jacobian, _ = evaluate(layout, body, q, device=device)
    expected = mujoco_jacobians(scene, f"robot/{link}", q)
    columns = chain_axes(layout, body)
    np.testing.assert_allclose(jacobian, expected[..., columns], atol=1e-5)
    others = np.setdiff1d(np.arange(layout.nv), columns)
    np.testing.assert_array_equal(expected[..., others], 0.0)


@pytest.mark.parametrize("name", [name for name, (asset, _) in ROBOTS.items() if asset.endswith(".urdf")])
def test_jacobians_are_pinocchios(name):
    need("pinocchio")
    import pinocchio

    asset, link = ROBOTS[name]
    scene = scene_of(asset)
    layout = compiled(scene).layout
    body = layout.body_name.index(f"robot/{link}")
    q = postures(layout, seed=7)
    poses, jacobian, _ = evaluate(layout, body, q)
    model = pinocchio.buildModelFromUrdf(str(resolve_asset(asset, base=None, key="", file=None)))
    data, columns = model.createData(), chain_axes(layout, body)
    root = pinocchio.XYZQUATToSE3(np.array([0.3, -0.2, 0.9, *np.array([0.2, 0.4, -0.1, 0.7]) / np.sqrt(0.7)]))
    for at in np.ndindex(q.shape[:2]):
        there = pinocchio.neutral(model)
        for dof, full in enumerate(layout.dof_name):
            joint = model.joints[model.getJointId(full.removeprefix("robot/"))]
            value = q[(*at, layout.dof_coord[dof])]
            there[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else [np.cos(value), np.sin(value)]
        frame = pinocchio.LOCAL_WORLD_ALIGNED
        found = pinocchio.computeFrameJacobian(model, data, there, model.getFrameId(link), frame)
        pinocchio.framesForwardKinematics(model, data, there)
        place = root * data.oMf[model.getFrameId(link)]
        np.testing.assert_allclose(place.translation, poses[(*at, body)][:3], atol=1e-5)
        turned = np.concatenate([root.rotation @ found[:3], root.rotation @ found[3:]])
        own = [model.joints[model.getJointId(layout.dof_name[dof].removeprefix("robot/"))].idx_v for dof in columns]
        np.testing.assert_allclose(jacobian[at], turned[:, own], atol=1e-5)


def moved(layout: Layout, body: int, q: np.ndarray, dof: int, step: float) -> np.ndarray:
    """A body's twist [T, W, 6] by one joint coordinate, from central differences of its pose."""
    poses = []
    for way in (step, -step):
        there = q.copy()
        there[..., layout.dof_coord[dof]] += way
        poses.append(evaluate(layout, body, there)[0][:, :, body].astype(np.float64))
    ahead, behind = poses
    turns = [Rotation.from_quat(pose[..., 3:].reshape(-1, 4)) for pose in poses]
    turn = (turns[0] * turns[1].inv()).as_rotvec().reshape(*q.shape[:2], 3)
    return np.concatenate([ahead[..., :3] - behind[..., :3], turn], axis=-1) / (2.0 * step)


def test_joints_of_several_axes_move_a_hand_as_its_jacobian_says(tmp_path):
    # three hinges on one body, a slide and two hinges on the next, on a free root
    layout = compiled(chain_scene(tmp_path)).layout
    body = layout.body_name.index("chain/hand")
    q = postures(layout, seed=3)
    _, jacobian, _ = evaluate(layout, body, q)
    columns = chain_axes(layout, body)
    names = ["hand_2", "hand_1", "hand_x", "arm_3", "arm_2", "arm_1"]
    assert [layout.dof_name[dof] for dof in columns] == [f"chain/{name}" for name in names]
    for i, dof in enumerate(columns):
        np.testing.assert_allclose(jacobian[..., i], moved(layout, body, q, dof, 1e-2), atol=1e-3)


def test_a_ball_joint_on_the_way_is_refused(tmp_path):
    layout = compiled(chain_scene(tmp_path)).layout
    with pytest.raises(ValueError, match="neck"):
        chain_axes(layout, layout.body_name.index("chain/head"))


def reference_measure(jacobian: np.ndarray) -> np.ndarray:
    """√det(J Jᵀ), or √det(Jᵀ J), from the singular values, in float64."""
    return np.prod(np.linalg.svd(jacobian, compute_uv=False), axis=-1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("name", "first"), [("panda", 0), ("mobile", 0), ("ur5", 0), ("panda", 2), ("panda", 5)])
def test_manipulability_matches_float64(name, first, seed, device):
    asset, link = ROBOTS[name]
    scene = scene_of(asset)
    layout = compiled(scene).layout
    body = layout.body_name.index(f"robot/{link}")
    q = postures(layout, seed=seed, shape=(4, 50))
    if name == "mobile":
        q[..., :2] += 3.0  # away from the origin
    columns = chain_axes(layout, body)[first:]
    _, _, measure = evaluate(layout, body, q, columns=columns, device=device)
    expected = reference_measure(mujoco_jacobians(scene, f"robot/{link}", q)[..., columns])
    np.testing.assert_allclose(measure, expected, rtol=1e-4, atol=5e-5)


def test_manipulability_of_a_distant_point_is_as_exact(device):
    asset, link = ROBOTS["panda"]
    scene = scene_of(asset)
    layout = compiled(scene).layout
    body = layout.body_name.index(f"robot/{link}")
    q = postures(layout, seed=5, shape=(4, 50))
    _, _, measure = evaluate(layout, body, q, away=30.0, device=device)
    expected = reference_measure(mujoco_jacobians(scene, f"robot/{link}", q)[..., chain_axes(layout, body)])
    np.testing.assert_allclose(measure, expected, rtol=1e-4, atol=5e-5)


def test_a_stretched_arm_cannot_be_moved_every_way(device):
    asset, link = ROBOTS["panda"]
    layout = compiled(scene_of(asset)).layout
    body = layout.body_name.index(f"robot/{link}")
    _, _, measure = evaluate(layout, body, np.zeros((1, 1, layout.nq), dtype=np.float32), device=device)
    assert measure == pytest.approx(0.0, abs=1e-3)


@wp.kernel
def solve_kernel(
    # inputs
    m: wp.array[wp.spatial_matrix],
    b: wp.array[wp.spatial_vector],
    damping: float,
    # outputs
    x: wp.array[wp.spatial_vector],
):
    """One thread: one system."""
    i = wp.tid()
    x[i] = solve_damped(m[i], damping, b[i])


def test_systems_are_solved(device):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(20, 6, 8))
    m, b = root @ root.transpose(0, 2, 1), rng.normal(size=(20, 6))
    x = wp.zeros(20, dtype=wp.spatial_vector, device=device)
    arrays = [wp.array(m, dtype=wp.spatial_matrix, device=device), wp.array(b, dtype=wp.spatial_vector, device=device)]
    wp.launch(solve_kernel, 20, [*arrays, 0.3], [x], device=device)
    expected = np.linalg.solve(m + 0.3 * np.eye(6), b[..., None])[..., 0]
    np.testing.assert_allclose(x.numpy(), expected, rtol=2e-4, atol=2e-4)
