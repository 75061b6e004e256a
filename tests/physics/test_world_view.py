# SPDX-License-Identifier: Apache-2.0
"""What rewards and observations see of a world, and indices that are out of range."""

import mujoco
import numpy as np
import pytest
import warp as wp

from warpmpc.physics import BatchSimulator
from warpmpc.physics.vector_env import BatchVectorEnv
from warpmpc.physics.world_view import (
    WorldView,
    body_position,
    body_rotation,
    contact_force,
    control,
    control_before,
    joint_position,
    joint_velocity,
    sensor,
    step_time,
)

TEXT = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="4 4 .1"/>
    <body name="ball" pos="0 0 .1"><freejoint/><geom size=".1" mass="2"/></body>
  </worldbody>
  <actuator><motor joint="reel" gear="0"/></actuator>
  <sensor><framepos objtype="body" objname="ball"/></sensor>
</mujoco>
""".replace(
    "<worldbody>",
    '<worldbody><body pos="2 0 1"><joint name="reel"/><geom size=".1" contype="0" conaffinity="0"/></body>',
)

MODEL = mujoco.MjModel.from_xml_string(TEXT)


@wp.func
def pushed(s: WorldView) -> float:
    return control(s, 0) * control(s, 0)


@wp.func
def look(s: WorldView, o: wp.array[float]):
    at, turn, force = body_position(s, 2), body_rotation(s, 2), contact_force(s, 0)
    for i in range(3):
        o[i] = at[i]
        o[7 + i] = force[i]
        o[10 + i] = sensor(s, i)
    for i in range(4):
        o[3 + i] = turn[i]
    o[13] = step_time(s)
    o[14] = control(s, 0)
    o[15] = control_before(s, 0)


def test_a_view_shows_the_world(device):
    sim = BatchSimulator(MODEL, 3, device=device, contact_pairs=[("ball", "world")])
    turned = np.array([0.5, 0.5, -0.5, 0.5])
    start = np.r_[0.0, 0.3, -0.2, 0.1, turned]
    env = BatchVectorEnv(
        sim,
        observe=look,
        size=16,
        rewards={step_time: 2.0, pushed: 1.0},
        start=lambda rng, worlds: {"qpos": np.repeat(start[None], len(worlds), axis=0)},
        actions=([0.5], [2.0]),
        max_episode_steps=6,
    )
    seen, _ = env.reset(seed=0)
    np.testing.assert_allclose(seen[1, :3], start[1:4], atol=1e-6)
    np.testing.assert_allclose(seen[1, 3:7], turned[[1, 2, 3, 0]], atol=1e-6)
    np.testing.assert_array_equal(seen[:, 13:], [[0.0, 0.5, 0.5]] * 3)  # at rest
    for value, (now, before) in {0.25: (1.0, 0.5), -7.0: (-1.5, 1.0)}.items():
        seen, reward, *_ = env.step(np.full((3, 1), value))
        np.testing.assert_array_equal(seen[:, 14:], [[now, before]] * 3)
        terms = env.reward_terms()
        np.testing.assert_allclose(reward, terms["step_time"] + terms["pushed"])
        np.testing.assert_allclose(terms["pushed"], now * now)
    env.set_weights(pushed=10.0)
    for _ in range(3):
        seen, reward, *_ = env.step(np.zeros((3, 1)))
    np.testing.assert_allclose(seen[:, 13], 0.025, atol=1e-6)
    np.testing.assert_allclose(reward, 2.0 * 0.025 + 10.0 * 0.25, rtol=1e-5)
    np.testing.assert_allclose(seen[:, 10:13], seen[:, :3], atol=1e-6)
    assert (np.abs(seen[:, 9] - 2.0 * 9.81) < 4.0).all()
    assert env.step(np.zeros((3, 1)))[3].all()
    seen, reward, *ends, _ = env.step(np.ones((3, 1)))  # begins anew
    np.testing.assert_array_equal(seen[:, 13:], [[0.0, 0.5, 0.5]] * 3)
    assert not np.any([reward, *ends])
    seen = env.step(np.full((3, 1), 0.25))[0]
    again, _ = env.reset(options={"reset_mask": np.array([True, False, False])})
    np.testing.assert_array_equal(again[1:], seen[1:])
    assert not np.array_equal(again[0], seen[0])


@wp.func
def write_at(s: WorldView, o: wp.array[float]):
    o[wp.int32(joint_position(s, 0))] = 1.0


@pytest.mark.parametrize("at", [4, 100, 100_000, -1, -3])
def test_an_observation_longer_than_its_size_is_told(at):
    simulator = BatchSimulator(MODEL, 3)
    simulator.qpos[:, 0] = at
    with pytest.raises(ValueError, match="beyond size=4"):
        BatchVectorEnv(simulator, observe=write_at, size=4, rewards={step_time: 1.0})


KINDS = ("coordinate", "velocity", "body", "body", "sensor", "pair", "control", "control")


@wp.func
def read_at(s: WorldView, o: wp.array[float]):
    kind, i = wp.int32(joint_position(s, 0)), wp.int32(joint_velocity(s, 0))
    if kind == 1:
        o[0] = joint_position(s, i)
    elif kind == 2:
        o[0] = joint_velocity(s, i)
    elif kind == 3:
        o[0] = body_position(s, i)[0]
    elif kind == 4:
        o[0] = body_rotation(s, i)[0]
    elif kind == 5:
        o[0] = sensor(s, i)
    elif kind == 6:
        o[0] = contact_force(s, i)[0]
    elif kind == 7:
        o[0] = control(s, i)
    elif kind == 8:
        o[0] = control_before(s, i)


@pytest.mark.parametrize("at", [-1, 9, 1_000_000])
def test_an_index_out_of_range_is_an_error(at):
    now = [1, 0]

    def start(rng, worlds):
        qpos, qvel = MODEL.qpos0.copy(), np.zeros(MODEL.nv)
        qpos[0], qvel[0] = now
        return {"qpos": qpos, "qvel": qvel}

    sim = BatchSimulator(MODEL, 3, contact_pairs=[("ball", "world")])
    env = BatchVectorEnv(sim, observe=read_at, size=4, rewards={step_time: 1.0}, start=start)
    for kind, what in enumerate(KINDS, start=1):
        for i in (0, at):
            now[:] = kind, i
            if i == 0:
                env.reset()
                continue
            with pytest.raises(IndexError, match=what):
                env.reset()
