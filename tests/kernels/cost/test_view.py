# SPDX-License-Identifier: Apache-2.0
"""The pieces cost terms are made of: angles on the circle, rotations, distances to shapes, frames of all kinds."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from warpmpc import StepView, frame_angular_velocity, frame_pose, frame_velocity, step_length, step_time, task_scalar
from warpmpc.kernels.cost.points import shape_distance
from warpmpc.kernels.cost.view import rotation_angle, wrap_angle, yaw
from warpmpc.kernels.geometry.fields import PathFields, plane_distance


@wp.kernel
def angle_kernel(
    # inputs
    a: wp.array[wp.quat],
    b: wp.array[wp.quat],
    angle: wp.array[float],
    # outputs
    out: wp.array2d[float],
):
    """Every angle function at one pair of rotations."""
    i = wp.tid()
    out[0, i] = yaw(a[i])
    out[1, i] = rotation_angle(a[i], b[i])
    out[2, i] = wrap_angle(angle[i])


def angles(a: np.ndarray, b: np.ndarray, angle: np.ndarray, device: str) -> np.ndarray:
    """Headings of a, rotation angles a → b and wrapped angles, ``[3, n]``."""
    out = wp.zeros((3, len(a)), dtype=float, device=device)
    inputs = [wp.array(q, dtype=wp.quat, device=device) for q in (a, b)]
    inputs.append(wp.array(angle, dtype=float, device=device))
    wp.launch(angle_kernel, dim=len(a), inputs=inputs, outputs=[out], device=device)
    return out.numpy()


@pytest.mark.parametrize("seed", range(3))
def test_angles_match_float64(seed, device):
    rng = np.random.default_rng(seed)
    a, b = (Rotation.random(200, rng=rng) for _ in range(2))
    angle = rng.uniform(-20.0, 20.0, size=200)
    heading, between, wrapped = angles(a.as_quat(), b.as_quat(), angle, device)
    x_axis = a.apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(heading, np.arctan2(x_axis[:, 1], x_axis[:, 0]), atol=1e-4)
    np.testing.assert_allclose(between, (a.inv() * b).magnitude(), atol=1e-5)
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-5)
    assert np.all(np.abs(wrapped) <= np.pi + 1e-6)


def test_a_rotation_and_its_negative_are_the_same_and_small_angles_stay_accurate(device):
    a = Rotation.random(5, rng=np.random.default_rng(0))
    small = np.array([0.0, 1e-4, 1e-3, 0.5, np.pi])
    b = a * Rotation.from_rotvec(small[:, None] * [0.6, 0.0, 0.8])
    for sign in (1.0, -1.0):
        _, between, _ = angles(a.as_quat(), sign * b.as_quat(), small, device)
        np.testing.assert_allclose(between, small, atol=2e-6)


@wp.kernel
def shape_kernel(
    # inputs
    kind: int,
    size: wp.vec3,
    point: wp.array[wp.vec3],
    # outputs
    out: wp.array[float],
):
    """Distance of one point."""
    i = wp.tid()
    out[i] = shape_distance(kind, size, point[i])


def surface(kind: str, size: tuple[float, ...], count: int, rng) -> np.ndarray:
    """Random points on the surface of a shape, dense enough to stand for it, ``[count, 3]``."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if kind == "sphere":
        return size[0] * direction
    if kind == "capsule":
        side = rng.random(count) < 0.5
        ring = direction * [1.0, 1.0, 0.0]
        ring = size[0] * ring / np.linalg.norm(ring, axis=1, keepdims=True) + [0.0, 0.0, 1.0] * rng.uniform(
            -size[1], size[1], (count, 1)
        )
        return np.where(side[:, None], ring, size[0] * direction + np.sign(direction[:, 2:]) * [0.0, 0.0, size[1]])
    if kind == "box":
        points = rng.uniform(-1.0, 1.0, size=(count, 3))
        face = rng.integers(3, size=count)
        points[np.arange(count), face] = np.sign(points[np.arange(count), face])
        return points * size
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, count), size[0] * np.sqrt(rng.random(count))
    z = rng.uniform(-size[1], size[1], count)
    side = rng.random(count) < 0.5
    radius, z = np.where(side, size[0], radius), np.where(side, z, size[1] * np.sign(z))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


@pytest.mark.parametrize(
    ("kind", "code", "size"),
    [
        ("sphere", 0, (0.4, 0.0, 0.0)),
        ("box", 1, (0.3, 0.5, 0.2)),
        ("cylinder", 2, (0.3, 0.4, 0.0)),
        ("capsule", 3, (0.2, 0.5, 0.0)),
    ],
)
def test_distances_to_shapes_are_those_to_their_nearest_surface_point(kind, code, size, device):
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(code)
    points = rng.uniform(-1.2, 1.2, size=(300, 3))
    out = wp.zeros(300, dtype=float, device=device)
    inputs = [code, wp.vec3(*size), wp.array(points, dtype=wp.vec3, device=device)]
    wp.launch(shape_kernel, dim=300, inputs=inputs, outputs=[out], device=device)
    nearest, _ = cKDTree(surface(kind, size, 100_000, rng)).query(points)
    np.testing.assert_allclose(np.abs(out.numpy()), nearest, atol=0.01)
    inside = {
        "sphere": np.linalg.norm(points, axis=1) < size[0],
        "box": np.all(np.abs(points) < size, axis=1),
        "cylinder": (np.hypot(*points.T[:2]) < size[0]) & (np.abs(points[:, 2]) < size[1]),
        "capsule": np.hypot(np.hypot(*points.T[:2]), np.maximum(np.abs(points[:, 2]) - size[1], 0.0)) < size[0],
    }[kind]
    assert inside.any()
    np.testing.assert_array_equal(out.numpy() < 0.0, inside)


def test_the_distance_to_a_plane_is_the_height_above_it(device):
    points = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    out = wp.zeros(20, dtype=float, device=device)
    inputs = [4, wp.vec3(0.0), wp.array(points, dtype=wp.vec3, device=device)]
    wp.launch(shape_kernel, dim=20, inputs=inputs, outputs=[out], device=device)
    np.testing.assert_array_equal(out.numpy(), points[:, 2])


@wp.kernel
def frame_kernel(
    # inputs
    view: StepView,
    # outputs
    pose: wp.array2d[wp.transform],
    velocity: wp.array2d[wp.vec3],
    angular: wp.array2d[wp.vec3],
):
    """Pose and velocities of one frame in one world."""
    w, f = wp.tid()
    s = view
    s.t = 1
    s.w = w
    s.e = w // 2
    pose[w, f] = frame_pose(s, f)
    velocity[w, f] = frame_velocity(s, f)
    angular[w, f] = frame_angular_velocity(s, f)


def poses(*shape: int, seed: int) -> np.ndarray:
    """Random poses ``[*shape, 7]``."""
    rng = np.random.default_rng(seed)
    count = int(np.prod(shape))
    return np.concatenate([rng.normal(size=(count, 3)), Rotation.random(count, rng=rng).as_quat()], 1).reshape(
        *shape, 7
    )


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pose of b in the frame of a, ``[7]``."""
    turn = Rotation.from_quat(a[3:])
    return np.concatenate([a[:3] + turn.apply(b[:3]), (turn * Rotation.from_quat(b[3:])).as_quat()])


def test_frames_move_with_their_body_or_stand_in_the_world_or_at_the_goal(device):
    body_q, goal, local = poses(2, 4, 3, seed=0), poses(2, 2, seed=1), poses(4, seed=2)
    com = np.random.default_rng(4).normal(size=(3, 3))
    body_qd = np.random.default_rng(3).normal(size=(2, 4, 3, 6))
    view = StepView()
    view.body_q = wp.array(body_q, dtype=wp.transform, device=device)
    view.body_qd = wp.array(body_qd, dtype=wp.spatial_vector, device=device)
    view.pose = wp.array(goal, dtype=wp.transform, device=device)
    view.body_com = wp.array(com, dtype=wp.vec3, device=device)
    view.frame_body = wp.array([2, -1, -2, -3], dtype=int, device=device)
    view.frame_pose = wp.array(local, dtype=wp.transform, device=device)
    pose = wp.zeros((4, 4), dtype=wp.transform, device=device)
    velocity, angular = (wp.zeros((4, 4), dtype=wp.vec3, device=device) for _ in range(2))
    wp.launch(frame_kernel, dim=(4, 4), inputs=[view], outputs=[pose, velocity, angular], device=device)
    for w in range(4):
        goals = goal[w // 2]
        expected = [compose(body_q[1, w, 2], local[0]), local[1], *(compose(goals[i], local[2 + i]) for i in (0, 1))]
        for f in range(4):
            found = pose.numpy()[w, f]
            np.testing.assert_allclose(found[:3], expected[f][:3], atol=1e-5)
            assert abs(found[3:] @ expected[f][3:]) == pytest.approx(1.0, abs=1e-5)
        # the twist is that of the centre of mass: the frame's origin goes around it
        twist, turn = body_qd[1, w, 2], Rotation.from_quat(body_q[1, w, 2, 3:])
        moving = twist[:3] + np.cross(twist[3:], turn.apply(local[0, :3] - com[2]))
        np.testing.assert_allclose(velocity.numpy()[w], [moving, *np.zeros((3, 3))], atol=2e-5)
        np.testing.assert_allclose(angular.numpy()[w], [twist[3:], *np.zeros((3, 3))], atol=1e-6)


@wp.kernel
def time_kernel(
    # inputs
    view: StepView,
    # outputs
    out: wp.array3d[float],
):
    """Time, length of the step and the second scalar of the task at one step in one world."""
    t, w = wp.tid()
    s = view
    s.t = t + 1
    s.w = w
    s.e = w // 2
    out[0, t, w] = step_time(s)
    out[1, t, w] = step_length(s)
    out[2, t, w] = task_scalar(s, 1)


def test_a_step_knows_its_time_and_length_and_the_tasks_scalars(device):
    view = StepView()
    view.start = wp.array([2.0, 5.0], dtype=float, device=device)
    view.step_end = wp.array([0.0, 0.1, 0.25, 0.65], dtype=float, device=device)
    view.scalar = wp.array([[1.0, 3.0], [2.0, 4.0]], dtype=float, device=device)
    out = wp.zeros((3, 3, 4), dtype=float, device=device)
    wp.launch(time_kernel, dim=(3, 4), inputs=[view], outputs=[out], device=device)
    start = np.array([2.0, 2.0, 5.0, 5.0])
    np.testing.assert_allclose(out.numpy()[0], start + np.array([[0.1], [0.25], [0.65]]), rtol=1e-6)
    np.testing.assert_allclose(out.numpy()[1], np.tile([[0.1], [0.15], [0.4]], 4), rtol=1e-5)
    np.testing.assert_array_equal(out.numpy()[2], np.tile([3.0, 3.0, 4.0, 4.0], (3, 1)))


@wp.kernel
def plane_distance_kernel(
    # inputs
    view: StepView,
    paths: PathFields,
    field: int,
    target: wp.vec2,
    point: wp.array[wp.vec2],
    # outputs
    out: wp.array2d[float],
):
    """Distance of one point in one environment."""
    e, i = wp.tid()
    s = view
    s.e = e
    out[e, i] = plane_distance(s, paths, field, target, point[i])


def test_the_detour_of_the_field_is_added_to_the_straight_distance(device):
    rng = np.random.default_rng(0)
    cell, origin, center = 0.1, np.array([-1.0, -2.0]), np.array([[0.3, 0.4], [-0.2, 0.5], [0.0, 0.0], [0.1, 0.2]])
    grid = np.stack(np.meshgrid(origin[0] + cell * np.arange(40), origin[1] + cell * np.arange(40)), axis=-1)
    # field 1 of environment 1 knows of a detour of 0.7 m, the others of none
    detour = np.array([0.0, 0.0, 0.0, 0.7])
    field = np.linalg.norm(grid[None] - center[:, None, None], axis=-1) + detour[:, None, None]
    paths = PathFields()
    paths.count, paths.cell, paths.origin = 2, cell, wp.vec2(*origin)
    paths.length = wp.array(field, dtype=float, device=device)
    paths.center = wp.array(center, dtype=wp.vec2, device=device)
    points = rng.uniform([-0.9, -1.9], [2.0, 1.0], size=(50, 2))
    target = np.array([0.15, 0.1])  # has moved since the field was computed
    straight = np.linalg.norm(points - target, axis=1)
    for chosen in (-1, 0, 1):
        out = wp.zeros((2, 50), dtype=float, device=device)
        inputs = [StepView(), paths, chosen, wp.vec2(*target), wp.array(points, dtype=wp.vec2, device=device)]
        wp.launch(plane_distance_kernel, dim=(2, 50), inputs=inputs, outputs=[out], device=device)
        extra = 0.7 - 0.25 * cell if chosen == 1 else 0.0
        np.testing.assert_allclose(out.numpy()[0], straight, atol=1e-5)
        np.testing.assert_allclose(out.numpy()[1], straight + extra, atol=0.03 if extra else 1e-5)
