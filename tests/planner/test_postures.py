# SPDX-License-Identifier: Apache-2.0
"""Rows that go to postures in which a frame is where it is wanted."""

import numpy as np
import pytest
import warp as wp
from arms import arm_scene

from warpmpc import Controller, SceneError, State
from warpmpc.kernels.geometry.kinematics import forward_kinematics_kernel
from warpmpc.planner.proposers import NEAR, PostureSamples
from warpmpc.scene.model.joints import joint_table
from warpmpc.scene.schema import DriveMode

GOAL = {"frame": "arm/panda_link7", "position": (0.45, 0.2, 0.4), "rotation": (1.0, 0.0, 0.0, 0.0)}


def reaching(mode="acceleration", goal=GOAL, **postures):
    """A Panda whose rows of postures are to be looked at."""
    planner = {"samples": 64, "horizon": 10, "dt": 0.1, "postures": {"of": "arm/panda_link7", **postures}}
    scene = arm_scene("panda", goal=goal, success={"distance": 0.01}, planner=planner)
    drive = {"mode": DriveMode(mode), "damping": (10.0,), "limit": (20.0,)}
    drive["stiffness"] = (100.0,) if mode == "position" else (0.0,)
    robot = scene.robot[0]
    robot = robot.model_copy(update={"drive": tuple(d.model_copy(update=drive) for d in robot.drive)})
    scene = scene.model_copy(update={"robot": (robot,)})
    return Controller(scene, device="cpu", engine="kinematic", seed=0)


def plan(mpc, times=40, state=None):
    layout = mpc.layout
    state = state or State(layout.joint_q, np.zeros(layout.nv, dtype=np.float32))
    for _ in range(times):
        mpc.step(state)
    return next(one for one in mpc.plan_step.strategy.proposers if isinstance(one, PostureSamples))


def found(postures):
    """Postures that have found the pose ``[n, nq]``."""
    return postures.postures.numpy()[0][postures._miss.numpy().ravel() <= NEAR]


def test_postures_bring_the_frame_to_the_goal_within_the_limits():
    mpc = reaching()
    q, layout = found(plan(mpc)), mpc.layout
    assert len(q) >= 2
    lower, upper = layout.dof_lower[:7], layout.dof_upper[:7]
    assert np.all((q[:, :7] >= lower - 1e-5) & (q[:, :7] <= upper + 1e-5))
    body_q = wp.zeros((1, len(q), layout.nb), dtype=wp.transform, device="cpu")
    body_qd = wp.zeros((1, len(q), layout.nb), dtype=wp.spatial_vector, device="cpu")
    inputs = [wp.array(a[None], dtype=float, device="cpu") for a in (q, np.zeros((len(q), layout.nv)))]
    table = joint_table(layout, "cpu", worlds=len(q))
    wp.launch(forward_kinematics_kernel, (1, len(q)), inputs=[table, *inputs], outputs=[body_q, body_qd], device="cpu")
    hand = body_q.numpy()[0, :, layout.frame_body[layout.frame("arm/panda_link7")]]
    np.testing.assert_allclose(hand[:, :3], np.tile(GOAL["position"], (len(q), 1)), atol=NEAR)
    assert np.all(np.abs(hand[:, 3:] @ GOAL["rotation"]) > np.cos(0.5 * NEAR) - 1e-5)


@pytest.mark.parametrize("mode", ["acceleration", "velocity", "position"])
def test_a_row_leads_to_its_posture(mode):
    mpc = reaching(mode, durations=[0.9], count=4)
    postures = plan(mpc)
    at = int(np.argmin(postures._miss.numpy().ravel()))
    knots = postures.knots.numpy()[at, 0]
    way = postures.postures.numpy()[0, at, :7] - mpc.layout.joint_q[:7]
    if mode == "position":
        moved = knots[-1] - mpc.layout.joint_q[:7]
    elif mode == "velocity":
        moved = 0.1 * knots.sum(axis=0)
    else:
        speed = np.concatenate([np.zeros((1, 7)), np.cumsum(0.05 * (knots[1:] + knots[:-1]), axis=0)])
        moved = np.trapezoid(speed, dx=0.1, axis=0)
    np.testing.assert_allclose(moved, way, atol=0.12 * np.abs(way).max())


def test_a_goal_out_of_reach_leaves_the_rows_asking_for_nothing():
    mpc = reaching(goal={**GOAL, "position": (3.0, 0.0, 0.5)})
    postures = plan(mpc)
    assert not len(found(postures))
    assert not postures.knots.numpy().any()
    mpc.task["goal"] = (*GOAL["position"], *GOAL["rotation"])
    assert len(found(plan(mpc)))


def test_the_same_seed_finds_the_same_postures_again():
    mpc = reaching()
    first = plan(mpc).postures.numpy().copy()
    mpc.reset()
    np.testing.assert_array_equal(plan(mpc).postures.numpy(), first)


def test_more_rows_than_samples_are_refused():
    with pytest.raises(SceneError, match="more than there are samples"):
        reaching(count=40)


@pytest.mark.parametrize(("keys", "key"), [({"to": "arm/panda_link7"}, "to"), ({"of": "nothing"}, "of")])
def test_what_cannot_be_is_refused(keys, key):
    with pytest.raises(SceneError) as error:
        reaching(**keys)
    assert error.value.key == f"planner.postures.{key}"
