# SPDX-License-Identifier: Apache-2.0
"""Operational-space control of the tracking study: what its torques do in MuJoCo's forward dynamics."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from studies.reach.osc import FREQUENCY, OperationalSpace, follow, with_torques

import warpmpc


def pose_of(data: mujoco.MjData, body: int) -> np.ndarray:
    """Pose of a body ``[7]``."""
    return np.concatenate([data.xpos[body], data.xquat[body][[1, 2, 3, 0]]])


@pytest.mark.parametrize("name", ["storm_track", "storm_hold_orientation"])
@pytest.mark.parametrize("seed", range(3))
def test_the_tool_accelerates_as_a_critically_damped_error_asks(name, seed):
    plant = warpmpc.Plant(with_torques(name, ()), seed=0)
    law, model, rng = OperationalSpace(plant), plant.model, np.random.default_rng(seed)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, dofs = mujoco.MjData(model), np.asarray(plant.layout.actuator_dof)
    body = model.body(plant.compiled.body_name[plant.layout.frame_body[plant.layout.frame("panda/tool")]]).id
    plant.show(data)
    data.qpos[dofs] += rng.normal(scale=0.2, size=len(dofs))
    data.qvel[:] = rng.normal(scale=0.5, size=model.nv)
    mujoco.mj_forward(model, data)
    at = pose_of(data, body)
    turn, way = rng.normal(scale=0.1, size=3), rng.normal(scale=0.05, size=3)
    goal = np.concatenate([at[:3] + way, (Rotation.from_rotvec(turn) * Rotation.from_quat(at[3:])).as_quat()])
    data.qfrc_applied[dofs] = law.torque(data, goal)
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    speed, found = np.zeros(6), np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, speed, 0)
    mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, found, 0)
    np.testing.assert_allclose(
        found[3:] + model.opt.gravity, FREQUENCY**2 * way - 2.0 * FREQUENCY * speed[3:], rtol=1e-6, atol=1e-6
    )
    if name == "storm_hold_orientation":
        expected = FREQUENCY**2 * turn - 2.0 * FREQUENCY * speed[:3]
        np.testing.assert_allclose(found[:3], expected, rtol=1e-6, atol=1e-6)


def test_the_hand_comes_to_the_moving_ball_and_stays_near():
    scene = with_torques("storm_track", ("timing.timeout=3.0",))
    plant, watch, _ = follow(scene, 100, lambda plant: Distance())
    assert not plant.diverged
    assert max(watch.of[-50:]) < 0.03


class Distance:
    """Distances of the tool from the goal, control by control."""

    def __init__(self):
        self.of: list[float] = []

    def __call__(self, controller: object, plant: warpmpc.Plant, control: np.ndarray) -> None:
        self.of.append(plant.error.position)
