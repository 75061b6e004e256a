# SPDX-License-Identifier: Apache-2.0
"""The backward pass of iLQG, against a plain Riccati recursion and the conditions of optimality under limits."""

import numpy as np
import pytest

from warpmpc.planner.derivatives.expansion import Linear, Quadratic, backward

ENVS, STEPS, N, NU = 2, 6, 5, 3
SCALE = np.array([1.0, 10.0, 0.1])
WIDE = np.full((ENVS, STEPS, NU), 1e6)


def random_problem(seed: int):
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return rng.standard_normal((ENVS, STEPS, *shape))

    root = normal(N + NU, N + NU)
    whole = root @ root.swapaxes(-1, -2) + 0.1 * np.eye(N + NU)
    model = Linear(0.5 * normal(N, N), normal(N, NU), normal(1), normal(1, N), normal(1, NU))
    cost = Quadratic(normal(N), normal(NU), whole[..., :N, :N], whole[..., N:, :N], whole[..., N:, N:])
    return model, cost


def total(model, cost, e, control, gain=None):
    """Cost of changes of the controls [T, nu] under the quadratic model, from x = 0; also the states."""
    x, value = np.zeros(N), 0.0
    for t in range(STEPS):
        u = control[t] if gain is None else control[t] + gain[t] @ x
        value += cost.x[e, t] @ x + cost.u[e, t] @ u + u @ cost.ux[e, t] @ x
        value += 0.5 * (x @ cost.xx[e, t] @ x + u @ cost.uu[e, t] @ u)
        x = model.a[e, t] @ x + model.b[e, t] @ u
    return value


def policy_cost(model, cost, solved, e, share):
    """Cost of the policy, its k times a share."""
    return total(model, cost, e, share * solved.change[e], solved.gain[e])


@pytest.mark.parametrize("seed", range(4))
def test_without_limits_it_finds_the_optimum_of_the_quadratic_model(seed):
    model, cost = random_problem(seed)
    solved = backward(model, cost, (-WIDE, WIDE), SCALE, np.zeros(ENVS))
    assert not solved.failed.any()
    for e in range(ENVS):
        best = policy_cost(model, cost, solved, e, 1.0)
        assert best < policy_cost(model, cost, solved, e, 0.9)
        assert best < policy_cost(model, cost, solved, e, 1.1)
        rng = np.random.default_rng(seed)
        for _ in range(20):  # no other gains or changes do better
            other = solved.change[e] + 0.1 * SCALE * rng.standard_normal((STEPS, NU))
            assert total(model, cost, e, other, solved.gain[e]) > best


@pytest.mark.parametrize("seed", range(4))
def test_limits_hold_and_what_they_hold_has_no_gain(seed):
    model, cost = random_problem(seed)
    room = np.broadcast_to(0.2 * SCALE, WIDE.shape)
    solved = backward(model, cost, (-room, room), SCALE, np.zeros(ENVS))
    held = np.isclose(np.abs(solved.change), room, atol=1e-12)
    assert held.any()
    assert not held.all()
    assert (np.abs(solved.change) <= room + 1e-12).all()
    assert (solved.gain[held] == 0.0).all()
    assert (np.abs(solved.gain[~held]).max(axis=-1) > 0.0).all()


def test_the_last_step_is_a_quadratic_program_with_limits():
    model, cost = random_problem(7)
    room = np.broadcast_to(0.2 * SCALE, WIDE.shape)
    u = backward(model, cost, (-room, room), SCALE, np.zeros(ENVS)).change[:, -1]
    slope = cost.u[:, -1] + np.einsum("eij,ej->ei", cost.uu[:, -1], u)
    free = np.abs(u) < room[:, -1] - 1e-12
    np.testing.assert_allclose((slope * SCALE)[free], 0.0, atol=1e-8)
    assert (slope[~free] * u[~free] <= 0.0).all()  # a limit holds what would go further


def test_a_model_without_a_minimum_is_told_and_damping_cures_it():
    model, cost = random_problem(3)
    cost.uu[0, 2] -= 200.0 * np.eye(NU)
    args = model, cost, (-WIDE, WIDE), np.ones(NU)
    assert backward(*args, np.zeros(ENVS)).failed.tolist() == [True, False]
    assert not backward(*args, np.array([1e4, 0.0])).failed.any()
