# SPDX-License-Identifier: Apache-2.0
"""The tangent space of states, against MuJoCo's own sums and differences."""

import mujoco
import numpy as np
import pytest

from warpmpc.physics.tangent import Tangent

MODEL = """
<mujoco>
  <worldbody>
    <body><freejoint/><geom size=".1"/>
      <body pos="0 0 1"><joint type="ball"/><geom size=".1"/>
        <body pos="0 0 1"><joint type="hinge"/><joint type="slide"/><geom size=".1"/></body>
      </body>
    </body>
    <body pos="2 0 0"><joint name="x" type="hinge"/><geom size=".1"/></body>
  </worldbody>
  <actuator><general joint="x" dyntype="integrator"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


def random_states(model, rng, count):
    states = rng.standard_normal((count, model.nq + model.nv + model.na))
    for row in states:
        mujoco.mj_normalizeQuat(model, row[: model.nq])
    return states


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0])
def test_sums_and_differences_are_those_of_mujoco(model, size):
    rng, tangent = np.random.default_rng(0), Tangent(model)
    states, steps = random_states(model, rng, 20), size * rng.uniform(-1.0, 1.0, (20, 2 * model.nv + model.na))
    moved = tangent.add(states, steps)
    for state, step, found in zip(states, steps, moved, strict=True):
        q = state[: model.nq].copy()
        mujoco.mj_integratePos(model, q, step[: model.nv], 1.0)
        np.testing.assert_allclose(found[: model.nq], q, atol=1e-14)
        np.testing.assert_allclose(found[model.nq :], state[model.nq :] + step[model.nv :], atol=1e-14)
        dq = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, dq, 1.0, state[: model.nq], q)
        np.testing.assert_allclose(tangent.subtract(found, state)[: model.nv], dq, atol=1e-13)
    np.testing.assert_allclose(tangent.subtract(moved, states), steps, atol=1e-13)


def test_the_two_quaternions_of_an_orientation_are_one(model):
    tangent = Tangent(model)
    state = random_states(model, np.random.default_rng(1), 1)[0]
    other = state.copy()
    other[3:7] *= -1.0
    np.testing.assert_allclose(tangent.subtract(other, state), 0.0, atol=1e-15)


def test_states_are_moved_along_one_number_each(model):
    rng, tangent = np.random.default_rng(3), Tangent(model)
    states, column = random_states(model, rng, 5), np.r_[: tangent.size, :3]
    step = rng.uniform(-1.0, 1.0, (5, len(column)))
    moved = tangent.displace(states, column, step)
    np.testing.assert_allclose(moved, tangent.add(states[:, None], step[..., None] * np.eye(tangent.size)[column]))
    still = np.repeat(states[:, None], len(column), axis=1)
    np.testing.assert_allclose(tangent.along(moved, still, column), step, atol=1e-12)
