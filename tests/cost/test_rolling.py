# SPDX-License-Identifier: Apache-2.0
"""The rolling ball: numbers that a term carries along a rollout, against the same sums in float64."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warpmpc
from warpmpc import Controller, SceneError, State

SMALL = ["planner.samples=24", "planner.horizon=8", "planner.knots=4", "planner.noise.sigma=3.0", "engine.threads=1"]


def expected(mpc: Controller, share: float, carried: float) -> np.ndarray:
    """Cost of the term over the horizon for every sample ``[S]``."""
    layout, grid = mpc.layout, mpc.planner.grid
    out = mpc.engine.rollouts(range(mpc.shape.worlds))
    frame, ball = layout.frame("panda/centre"), layout.frame("ball")
    body = int(layout.frame_body[frame])
    pose = out.body_q.numpy()[:, :, body].astype(float)
    twist = out.body_qd.numpy()[:, :, body].astype(float)
    turn = Rotation.from_quat(pose[..., 3:].reshape(-1, 4)).as_matrix().reshape(*pose.shape[:2], 3, 3)
    offset = layout.frame_pose[frame][:3].astype(float)
    origin = pose[..., :3] + turn @ offset
    arm = turn @ (offset - layout.body_com[body])
    velocity = twist[..., :3] + np.cross(twist[..., 3:], arm)
    at = out.body_q.numpy()[0, :, int(layout.frame_body[ball]), :3] - origin[0]
    start = int(layout.joint_qd_start[np.flatnonzero(layout.joint_child == layout.frame_body[ball])[0]])
    speed = mpc.planner.state.joint_qd.numpy()[0, start : start + 3].astype(float)
    speed = speed - velocity[0] - np.cross(twist[0, :, 3:], at)
    place, rate = (np.einsum("wji,wj->wi", turn[0], v)[:, :2] for v in (at, np.broadcast_to(speed, at.shape)))
    total = np.zeros(len(place))
    for t, dt in enumerate(grid.dt):
        pull = np.array([0.0, 0.0, -9.81 * dt]) - carried * (velocity[t + 1] - velocity[t])
        rate = rate + share * np.einsum("wji,wj->wi", turn[t + 1], pull)[:, :2]
        place = place + dt * rate
        total += grid.weight[t] * ((place**2).sum(axis=1) + 0.25 * (rate**2).sum(axis=1))
    return total


@pytest.mark.parametrize(("share", "carried"), [(5.0 / 7.0, True), (1.0, False)])
def test_a_ball_rolls_along_every_rollout_as_the_model_says(share, carried):
    keys = [f"cost.rolling_ball.share={share}", f"cost.rolling_ball.carried={str(carried).lower()}"]
    scene = warpmpc.load_scene("storm_balance", overrides=[*SMALL, *keys])
    for seed in range(2):
        mpc = Controller(scene, device="cpu", seed=seed)
        state = State.start(mpc.layout)
        qd = state.joint_qd.copy()
        ball = int(mpc.layout.joint_qd_start[len(mpc.layout.joint_type) - 1])
        qd[ball : ball + 2] = [0.1, -0.2]
        qd[:7] = np.random.default_rng(seed).normal(0.0, 0.2, 7)
        for _ in range(2):
            mpc.step(State(state.joint_q, qd))
        found = mpc.engine.total.numpy()[mpc.costs.labels.index("rolling_ball")]
        np.testing.assert_allclose(found, scene.cost[0].weight * expected(mpc, share, float(carried)), rtol=2e-3)


def test_only_spheres_that_move_freely_roll():
    scene = warpmpc.load_scene("storm_balance", overrides=SMALL)
    box = scene.object[0].model_copy(update={"shape": "box", "size": (0.03, 0.03, 0.03)})
    with pytest.raises(SceneError, match="only spheres roll"):
        Controller(scene.model_copy(update={"object": (box,)}), device="cpu")
