# SPDX-License-Identifier: Apache-2.0
"""Residual terms against float64, on rollouts of bodies that are anywhere."""

import numpy as np
import pytest
from rollouts import Rollouts
from scipy.spatial.transform import Rotation

from warpmpc import SceneError

SCALAR = {"height": 0.7, "speed": -0.4}


def smooth(x: np.ndarray, p: float) -> np.ndarray:
    return (np.sqrt(x * x + p * p) - p).sum(-1)


def mass_points(r: Rollouts, bodies) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses ``[n]``, and positions and velocities ``[T, W, n, 3]`` of the centres of mass of some bodies."""
    places, velocities = [], []
    for body in bodies:
        pose = r.trajectory.body_q.numpy()[1:, :, body].astype(float)
        turn = Rotation.from_quat(pose[..., 3:].reshape(-1, 4))
        places.append(pose[..., :3] + turn.apply(r.layout.body_com[body]).reshape(*pose.shape[:2], 3))
        velocities.append(r.trajectory.body_qd.numpy()[1:, :, body, :3].astype(float))
    return r.layout.body_mass[list(bodies)].astype(float), np.stack(places, 2), np.stack(velocities, 2)


def test_a_position_is_seen_from_means_of_frames_along_the_axes_that_count():
    r = Rollouts(
        {"term": "position_residual", "of": "base/tip"},
        {"term": "position_residual", "of": ["base/tip", "base/centre"], "relative_to": ["box", "wall", "goal"]},
        {"term": "position_residual", "of": "base/tip", "relative_to": "box", "axes": "z", "target": "height",
         "norm": {"kind": "smooth_abs", "p": 0.1}},
        {"term": "position_residual", "of": "box", "axes": "xz", "target": [0.3, "speed"],
         "norm": {"kind": "l2", "p": 0.2}},
        scalar=SCALAR,
    )  # fmt: skip
    tip, centre, box, wall, goal = (r.pose(name)[0] for name in ("base/tip", "base/centre", "box", "wall", "goal"))
    np.testing.assert_allclose(r.cost(0), 0.5 * (tip**2).sum(-1), rtol=1e-5)
    d = 0.5 * (tip + centre) - (box + wall + goal) / 3.0
    np.testing.assert_allclose(r.cost(1), 0.5 * (d**2).sum(-1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(r.cost(2), smooth((tip - box)[..., 2:] - 0.7, 0.1), rtol=1e-5, atol=1e-6)
    d = box[..., [0, 2]] - [0.3, -0.4]
    np.testing.assert_allclose(r.cost(3), np.sqrt((d**2).sum(-1) + 0.04) - 0.2, rtol=1e-5, atol=1e-6)


def tip_velocity(r: Rollouts) -> np.ndarray:
    """Velocity ``[T, W, 3]`` of the frame base/tip after every control."""
    index, (place, turn) = r.layout.frame("base/tip"), r.pose("base/tip")
    body, local = r.layout.frame_body[index], r.layout.frame_pose[index].astype(float)
    twist = r.trajectory.body_qd.numpy()[1:, :, body].astype(float)
    arm = (turn * Rotation.from_quat(local[3:]).inv()).apply(local[:3] - r.layout.body_com[body])
    return twist[..., :3] + np.cross(twist[..., 3:], arm.reshape(place.shape))


def test_a_velocity_along_a_heading_is_ahead_to_the_left_and_up():
    r = Rollouts(
        {"term": "velocity_residual", "of": "base/tip", "heading": "box", "target": ["speed", 0.2, 0.0]},
        {"term": "position_residual", "of": "base/tip", "relative_to": "box", "heading": "box", "axes": "y"},
        {"term": "velocity_residual", "of": "base/tip", "heading": "goal", "axes": "x"},
        scalar=SCALAR,
    )
    (tip, _), (box, turn) = r.pose("base/tip"), r.pose("box")
    velocity = tip_velocity(r)

    def along(v: np.ndarray, turn: Rotation) -> np.ndarray:
        """In a frame that has the heading of another one and stands upright."""
        x = turn.apply([1.0, 0.0, 0.0])
        upright = Rotation.from_euler("z", np.arctan2(x[:, 1], x[:, 0])[:, None])
        return upright.inv().apply(v.reshape(-1, 3)).reshape(v.shape)

    d = along(velocity, turn) - [SCALAR["speed"], 0.2, 0.0]
    np.testing.assert_allclose(r.cost(0), 0.5 * (d**2).sum(-1), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(r.cost(1), 0.5 * along(tip - box, turn)[..., 1] ** 2, rtol=1e-4, atol=1e-5)
    ahead = along(velocity, r.pose("goal")[1])[..., 0]
    np.testing.assert_allclose(r.cost(2), 0.5 * ahead**2, rtol=1e-4, atol=1e-5)


def test_a_frame_that_looks_straight_up_has_no_heading_and_asks_for_nothing_but_heights():
    up = {"name": "up", "position": [0.0, 0.0, 0.0], "rotation": [0.0, -(0.5**0.5), 0.0, 0.5**0.5]}
    r = Rollouts({"term": "velocity_residual", "of": "base/tip", "heading": "up"}, target=[up])
    np.testing.assert_allclose(r.cost(0), 0.5 * tip_velocity(r)[..., 2] ** 2, atol=0.05)


def test_centres_of_mass_and_their_velocities_are_those_of_all_that_hangs_on_a_link():
    com = {"centre_of_mass": "base"}
    r = Rollouts(
        {"term": "position_residual", "of": com, "lead": 0.2, "relative_to": "box", "axes": "xy"},
        {"term": "velocity_residual", "of": com, "axes": "xy", "target": [0.3, "speed"],
         "norm": {"kind": "smooth_abs", "p": 0.3}},
        {"term": "velocity_residual", "of": [com, {"centre_of_mass": "box"}], "relative_to": "base/tip"},
        {"term": "position_residual", "of": {"centre_of_mass": "base/base_link"}},
        scalar=SCALAR,
    )  # fmt: skip
    entity = r.layout.entity("base")
    m, x, v = mass_points(r, [body for body in entity.bodies if r.layout.body_mass[body] > 0.0])
    assert m.sum() > 0.0
    x, v = (np.einsum("n,twnk->twk", m / m.sum(), a) for a in (x, v))
    d = (x + 0.2 * v - r.pose("box")[0])[..., :2]
    np.testing.assert_allclose(r.cost(0), 0.5 * (d**2).sum(-1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(r.cost(1), smooth(v[..., :2] - [0.3, -0.4], 0.3), rtol=1e-5, atol=1e-6)
    _, _, v_box = mass_points(r, r.layout.entity("box").bodies)
    body = r.layout.frame_body[r.layout.frame("base/tip")]
    twist = r.trajectory.body_qd.numpy()[1:, :, body].astype(float)
    _, centre, _ = mass_points(r, [body])
    tip = twist[..., :3] + np.cross(twist[..., 3:], r.pose("base/tip")[0] - centre[:, :, 0])
    d = 0.5 * (v + v_box[:, :, 0]) - tip
    np.testing.assert_allclose(r.cost(2), 0.5 * (d**2).sum(-1), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(r.cost(3), 0.5 * (centre[:, :, 0] ** 2).sum(-1), rtol=1e-5)


def test_momenta_are_sums_over_all_bodies():
    r = Rollouts(
        {"term": "momentum_residual", "of": "base", "axes": "yz", "target": "speed"},
        {"term": "angular_momentum_residual", "of": "base", "axes": "xz", "target": [0.0, "speed"]},
        {"term": "angular_velocity_residual", "of": ["base/tip", "wall"], "relative_to": "box"},
        scalar=SCALAR,
    )
    bodies = [body for body in r.layout.entity("base").bodies if r.layout.body_mass[body] > 0.0]
    m, x, v = mass_points(r, bodies)
    p = np.einsum("n,twnk->twk", m, v)
    np.testing.assert_allclose(r.cost(0), 0.5 * ((p[..., 1:] + 0.4) ** 2).sum(-1), rtol=1e-5)
    total = np.cross(x - np.einsum("n,twnk->twk", m / m.sum(), x)[:, :, None], m[:, None] * v).sum(2)
    spins = r.trajectory.body_qd.numpy()[1:, :, :, 3:].astype(float)
    for body in bodies:
        turn = Rotation.from_quat(r.trajectory.body_q.numpy()[1:, :, body, 3:].reshape(-1, 4)).as_matrix()
        own = np.einsum("nij,jk,nlk,nl->ni", turn, r.layout.body_inertia[body], turn, spins[:, :, body].reshape(-1, 3))
        total += own.reshape(total.shape)
    d = total[..., [0, 2]] - [0.0, -0.4]
    np.testing.assert_allclose(r.cost(1), 0.5 * (d**2).sum(-1), rtol=1e-4, atol=1e-5)
    tip, box = (spins[:, :, r.layout.frame_body[r.layout.frame(name)]] for name in ("base/tip", "box"))
    np.testing.assert_allclose(r.cost(2), 0.5 * ((0.5 * tip - box) ** 2).sum(-1), rtol=1e-5)


def test_rotations_are_as_long_as_twice_the_sine_of_half_their_angle():
    r = Rollouts(
        {"term": "rotation_residual", "of": "base/tip", "to": "box"},
        {"term": "rotation_residual", "of": "base/tip", "axes": "z", "norm": {"kind": "l2", "p": 0.1}},
    )
    tip, box, goal = (r.pose(name)[1] for name in ("base/tip", "box", "goal"))
    angle = r.each((box.inv() * tip).magnitude())
    np.testing.assert_allclose(r.cost(0), 2.0 * np.sin(0.5 * angle) ** 2, rtol=1e-4, atol=1e-6)
    z = r.each(((tip.apply([0, 0, 1.0]) - goal.apply([0, 0, 1.0])) ** 2).sum(-1)) / 2.0
    np.testing.assert_allclose(r.cost(1), np.sqrt(z + 0.01) - 0.1, rtol=1e-4, atol=1e-6)


def test_numbers_of_joints_controls_and_contacts_are_less_what_is_wanted():
    r = Rollouts(
        {"term": "posture_residual"},
        {"term": "posture_residual", "joints": ["yaw", "x"], "target": ["height", 0.2],
         "norm": {"kind": "smooth_abs", "p": 0.1}},
        {"term": "joint_velocity_residual", "joints": ["y"], "target": "speed"},
        {"term": "control_residual", "norm": {"kind": "cosh", "p": 0.9}},
        {"term": "control_residual", "controls": ["base/yaw"], "target": "speed"},
        {"term": "contact_residual", "between": ["box", "obstacles"], "least": 1.5, "target": 1.0},
        {"term": "contact_force_residual", "between": ["base", "box"], "axes": "yz", "target": [0.5, "speed"]},
        scalar=SCALAR,
    )  # fmt: skip
    out = r.trajectory
    q, qd, u, force = (a.numpy().astype(float) for a in (out.joint_q, out.joint_qd, r.control, out.contact_force))
    q, qd = q[1:, :, :3], qd[1:, :, :3]
    np.testing.assert_allclose(r.cost(0), 0.5 * ((q - [0.3, -0.2, 0.5]) ** 2).sum(-1), rtol=1e-5)
    np.testing.assert_allclose(r.cost(1), smooth(q[..., [2, 0]] - [0.7, 0.2], 0.1), rtol=1e-5)
    np.testing.assert_allclose(r.cost(2), 0.5 * (qd[..., 1] + 0.4) ** 2, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(r.cost(3), (0.81 * (np.cosh(u / 0.9) - 1.0)).sum(-1), rtol=1e-5)
    np.testing.assert_allclose(r.cost(4), 0.5 * (u[..., 2] + 0.4) ** 2, rtol=1e-4, atol=1e-6)
    pairs = len(r.layout.group("obstacles"))
    touches = np.linalg.norm(force[:, :, :pairs], axis=-1) > 1.5
    assert 0 < touches.sum() < touches.size
    np.testing.assert_allclose(r.cost(5), 0.5 * (~touches).sum(-1), rtol=1e-6)
    d = force[:, :, pairs, 1:] - [0.5, -0.4]
    np.testing.assert_allclose(r.cost(6), 0.5 * (d**2).sum(-1), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("cost", "message"),
    [
        ({"of": "base/tpi"}, r"cost\.position_residual\.of.*Did you mean 'base/tip'"),
        ({"of": ["base/tip", "bax"]}, r"cost\.position_residual\.of.*Did you mean 'box'"),
        ({"of": {"centre_of_mass": "bose"}}, r"cost\.position_residual\.of\.centre_of_mass.*Did you mean 'base'"),
        ({"of": {"centre_of_mass": "wall"}}, r"no such robot, object or link"),
        ({"of": "box", "target": "hight"}, r"cost\.position_residual\.target.*Did you mean 'height'"),
        ({"of": "box", "target": [1.0, 2.0]}, r"cost\.position_residual\.target.*1 or 3 values"),
        ({"of": "box", "axes": "zx"}, r"cost\.position_residual\.axes"),
        ({"of": "box", "axes": ""}, r"cost\.position_residual\.axes"),
        ({"of": "box", "norm": "l3"}, r"cost\.position_residual\.norm"),
        ({"of": "box", "norm": {"kind": "cosh"}}, r"cost\.position_residual\.norm.*takes p"),
        ({"of": "box", "relative_to": "flat", "axes": "z"}, r"cost\.position_residual\.axes.*no height"),
    ],
)
def test_mistakes_are_named(cost, message):
    with pytest.raises(SceneError, match=message):
        Rollouts(
            {"term": "position_residual", **cost}, scalar=SCALAR, target=[{"name": "flat", "position": (1.0, 0.0)}]
        )


def test_a_target_without_a_height_is_compared_in_the_plane():
    r = Rollouts(
        {"term": "position_residual", "of": "box", "relative_to": "flat"},
        target=[{"name": "flat", "position": (1.0, 0.0)}],
    )
    r.state.pose.assign(r.task.block[:, :14].reshape(2, 2, 7))
    d = (r.pose("box")[0] - [1.0, 0.0, 0.0])[..., :2]
    np.testing.assert_allclose(r.cost(), 0.5 * (d**2).sum(-1), rtol=1e-5, atol=1e-6)
