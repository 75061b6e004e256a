# SPDX-License-Identifier: Apache-2.0
"""Filters of poses against references in float64: least squares over everything, consistency, the gate."""

from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag, cholesky, expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from warpmpc.loop.estimation.free_joints import left_jacobian, log
from warpmpc.loop.estimation.measurement import History, PoseMeasured
from warpmpc.loop.estimation.scene_estimator import LONGEST, REJECTED, PoseFilter
from warpmpc.scene.schema_estimate import Estimate

NOISE = {"position": 0.01, "rotation": 0.05}
PROCESS = {"linear": 0.8, "angular": 2.0}
FINE = 4
"""Steps of the truth between two measurements: rotations do not add up."""
MODELS = ("constant_velocity", "constant_acceleration")


def make_filter(model="constant_velocity", **keys):
    return PoseFilter(Estimate(model=model, noise=NOISE, process=PROCESS, **keys))


def measured(time, position, rotation=(0.0, 0.0, 0.0, 1.0)):
    return PoseMeasured("box", float(time), np.r_[position, rotation])


@cache
def transition(order, dt, density):
    """Step and added covariance of one axis by Van Loan's matrix exponential ``[n + 1, n + 1]``."""
    n = order + 1
    rate = np.diag(np.ones(order), 1)
    grows = np.zeros((n, n))
    grows[-1, -1] = density
    big = expm(dt * np.block([[-rate, grows], [np.zeros((n, n)), rate.T]]))
    step = big[n:, n:].T
    grown = step @ big[:n, n:]
    return step, grown, cholesky(grown, lower=True)


class Simulation:
    """A pose that moves as a filter supposes, and its measurements."""

    def __init__(self, seed, *, order=1, count=60, mean_dt=1 / 30):
        rng = np.random.default_rng(seed)
        steps = rng.choice([0.3, 0.8, 1.2, 1.7], count) * mean_dt  # few, for the reference's exponentials
        self.times = np.cumsum(steps)
        spread = [PROCESS["linear"], PROCESS["angular"]]
        first = measured(self.times[0], rng.normal(size=3), Rotation.random(rng=rng).as_quat())
        # the truth is drawn about the first measurement, as the filter takes it
        chains = [rng.normal(size=(order + 1, 3)) * s for s in spread]
        for chain, noise in zip(chains, NOISE.values(), strict=True):
            chain[0] *= noise / spread[0 if noise == NOISE["position"] else 1]
        place = first.pose[:3] + chains[0][0]
        turn = Rotation.from_rotvec(chains[1][0]) * Rotation.from_quat(first.pose[3:])
        linear, angular = np.vstack([place, chains[0][1:]]), np.vstack([np.zeros(3), chains[1][1:]])
        self.measurements, self.truth = [first], [(linear, turn, angular)]
        for dt, time in zip(steps[1:], self.times[1:], strict=True):
            for _ in range(FINE):
                exact = [transition(order, dt / FINE, s**2) for s in spread]
                moves = [
                    step @ chain + root @ rng.normal(size=(order + 1, 3))
                    for (step, _, root), chain in zip(exact, (linear, angular), strict=True)
                ]
                linear, angular = moves
                turn = Rotation.from_rotvec(angular[0]) * turn
                angular[0] = 0.0
            self.truth.append((linear, turn, angular))
            seen = Rotation.from_rotvec(NOISE["rotation"] * rng.normal(size=3)) * turn
            self.measurements.append(measured(time, linear[0] + NOISE["position"] * rng.normal(size=3), seen.as_quat()))

    def estimates(self, filter):
        estimate = filter.start(self.measurements[0])
        yield estimate
        for measurement in self.measurements[1:]:
            estimate = filter.correct(filter.predict(estimate, measurement.time), measurement)
            yield estimate


def error(estimate, truth):
    """Error state of an estimate against the truth."""
    linear, turn, angular = truth
    off = (turn * Rotation.from_quat(estimate.rotation).inv()).as_rotvec()
    return np.concatenate(
        [
            linear[0] - estimate.position,
            (linear[1:] - estimate.linear).ravel(),
            off,
            (angular[1:] - estimate.angular).ravel(),
        ]
    )


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("seed", range(3))
def test_positions_are_those_of_least_squares_over_all_measurements(model, seed):
    """The last state of a Kalman filter is that of the batch problem: prior, steps and measurements, all weighed."""
    order = 1 + (model == MODELS[1])
    simulation = Simulation(seed, order=order, count=25)
    last = list(simulation.estimates(make_filter(model, gate=None)))[-1]
    n, count = order + 1, len(simulation.times)
    whiten = lambda covariance: np.linalg.inv(cholesky(covariance, lower=True))  # noqa: E731
    prior = np.diag(np.r_[NOISE["position"], np.full(order, PROCESS["linear"])] ** 2)
    rows, wanted = [np.hstack([whiten(prior), np.zeros((n, n * (count - 1)))])], []
    first = np.zeros((n, 3))
    first[0] = simulation.measurements[0].pose[:3]
    wanted.append(whiten(prior) @ first)
    for k in range(1, count):
        step, grown, _ = transition(order, simulation.times[k] - simulation.times[k - 1], PROCESS["linear"] ** 2)
        row = np.zeros((n, n * count))
        row[:, n * (k - 1) : n * k], row[:, n * k : n * (k + 1)] = -whiten(grown) @ step, whiten(grown)
        seen = np.zeros((1, n * count))
        seen[0, n * k] = 1.0 / NOISE["position"]
        rows += [row, seen]
        wanted += [np.zeros((n, 3)), simulation.measurements[k].pose[None, :3] / NOISE["position"]]
    solution = np.linalg.lstsq(np.vstack(rows), np.vstack(wanted), rcond=None)[0][-n:]
    np.testing.assert_allclose(last.position, solution[0], atol=1e-9)
    np.testing.assert_allclose(last.linear, solution[1:], atol=1e-6)
    information = np.vstack(rows).T @ np.vstack(rows)
    covariance = np.linalg.inv(information)[-n:, -n:]
    np.testing.assert_allclose(last.covariance[: 3 * n : 3, : 3 * n : 3], covariance, rtol=1e-4)


@pytest.mark.parametrize("model", MODELS)
def test_errors_are_as_large_as_the_covariance_says(model):
    """The normalized error squared over many seeds lies in its χ² interval (Bar-Shalom et al. 2001, 5.4.2)."""
    order, seeds = 1 + (model == MODELS[1]), 40
    filter, found = make_filter(model, gate=None), []
    for seed in range(seeds):
        simulation = Simulation(seed, order=order, count=30)
        estimates = list(simulation.estimates(filter))
        for k in (1, 10, 29):
            off = error(estimates[k], simulation.truth[k])
            found.append(off @ np.linalg.solve(estimates[k].covariance, off))
    found = np.reshape(found, (seeds, 3))
    size = 6 * (order + 1)
    low, high = chi2.ppf([0.001, 0.999], seeds * size) / seeds
    assert (found.mean(axis=0) > low).all()
    assert (found.mean(axis=0) < high).all()


def test_the_step_is_the_derivative_of_the_motion():
    """The covariance of a step from a certain state is that of many drawn errors, in a fast turn, too."""
    filter = make_filter()
    start = filter.start(measured(0.0, np.zeros(3)))
    rng, root = np.random.default_rng(0), 1e-3
    spin = np.array([[4.0, -7.0, 5.0]])
    covariance = root**2 * block_diag(np.eye(3), np.eye(3), np.eye(3), 25.0 * np.eye(3))
    base = type(start)(0.0, start.position, start.rotation, start.linear, spin, covariance, 0.0)
    moved = filter.predict(base, 0.1)
    mean = Rotation.from_quat(moved.rotation)
    rows = []
    for _ in range(4000):
        off = cholesky(covariance, lower=True) @ rng.normal(size=12)
        turned = Rotation.from_rotvec(0.1 * (spin[0] + off[9:])) * Rotation.from_rotvec(off[6:9])
        rows.append(np.r_[(turned * mean.inv()).as_rotvec(), off[9:]])
    grown = np.zeros((6, 6))
    step = transition(1, 0.1, PROCESS["angular"] ** 2)[1]
    grown[:] = np.kron(step, np.eye(3))
    drawn = np.cov(np.array(rows).T)
    np.testing.assert_allclose(moved.covariance[6:, 6:] - grown, drawn, atol=0.08 * drawn.max())


def test_the_jacobian_of_rotation_vectors():
    v, h = np.array([0.9, -1.2, 0.4]), 1e-6
    turn = Rotation.from_rotvec(v)
    found = [log((Rotation.from_rotvec(v + h * axis) * turn.inv()).as_quat()) / h for axis in np.eye(3)]
    np.testing.assert_allclose(left_jacobian(v), np.transpose(found), atol=1e-5)


def test_outliers_change_nothing_and_many_in_a_row_begin_anew():
    filter = make_filter()
    history = History(filter)
    for k in range(30):
        history.insert(measured(k / 30, [0.1 * k / 30, 0.0, 0.0]))
    before = history.at(1.01)
    history.insert(measured(1.0, [0.5, 0.0, 0.0]))
    after = history.at(1.01)
    np.testing.assert_array_equal(after.position, before.position)
    np.testing.assert_array_equal(after.linear, before.linear)
    history.insert(measured(1.01, [0.1, 0.0, 0.0], Rotation.from_rotvec([0.0, 0.0, 1.5]).as_quat()))
    np.testing.assert_array_equal(history.at(1.01).rotation, before.rotation)
    for k in range(1, REJECTED):
        history.insert(measured(1.0 + k / 30, [2.0, 0.0, 0.0]))
    assert history.at(1.2).position[0] == pytest.approx(2.0, abs=0.02)  # it has been carried elsewhere


def test_a_motion_without_measurements_ends():
    history = History(make_filter())
    for k in range(30):
        history.insert(measured(k / 30, [k / 30, 0.0, 0.0]))
    soon, late, later = (history.at(29 / 30 + after) for after in (0.1, LONGEST, 10.0))
    assert soon.position[0] == pytest.approx(29 / 30 + 0.1, abs=0.01)
    np.testing.assert_allclose(later.position, late.position)
    assert not later.linear.any()
