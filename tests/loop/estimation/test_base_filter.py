# SPDX-License-Identifier: Apache-2.0
"""The filter of a floating base against differences in float64, on motion that is known, over seeds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from warpmpc.loop.estimation.base_filter import GRAVITY, PHI, BaseFilter, FeetMeasured, P, V
from warpmpc.loop.estimation.free_joints import cross, matrix
from warpmpc.scene.schema_estimate import EstimateBase

FEET = np.array([[0.2, 0.15, -0.3], [0.2, -0.15, -0.3], [-0.2, 0.15, -0.3], [-0.2, -0.15, -0.3]])
RADIUS = 0.02
DT = 0.0025


def make_filter(feet=4, **keys):
    return BaseFilter(EstimateBase(feet=[f"f{i}" for i in range(feet)], **keys), feet)


def random_state(filter, rng):
    """An estimate with feet that stand and roll."""
    count = filter.feet
    return replace(
        filter.start(0.0, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)),
        velocity=rng.normal(size=3),
        feet=rng.normal(size=(count, 3)),
        contact=np.ones(count, dtype=bool),
        gyro_bias=0.1 * rng.normal(size=3),
        accel_bias=0.1 * rng.normal(size=3),
        spin=rng.normal(size=3),
        foot_spin=rng.normal(size=(count, 3)),
        arm=np.tile([0.0, 0.0, -RADIUS], (count, 1)),
    )


def error_of(filter, estimate, truth):
    """Error of an estimate ``[size]``, by the matrices of SE_{2+N}(3): its first order."""
    turn = estimate.rotation @ truth.rotation.T
    rows = [
        a - turn @ b
        for a, b in zip(
            (estimate.velocity, estimate.position, *estimate.feet),
            (truth.velocity, truth.position, *truth.feet),
            strict=True,
        )
    ]
    biases = estimate.gyro_bias - truth.gyro_bias, estimate.accel_bias - truth.accel_bias
    return np.concatenate([Rotation.from_matrix(turn).as_rotvec(), *rows, *biases])


def shown(state, *, arms=True, ground=True):
    """What joints show of a state's feet without noise."""
    zero, count = np.zeros((len(state.feet), 3)), len(state.feet)
    arm = np.tile([0.0, 0.0, -RADIUS], (count, 1)) @ state.rotation if arms else zero
    heights = state.feet[:, 2] + (arm @ state.rotation.T)[:, 2]
    return FeetMeasured(
        position=(state.feet - state.position) @ state.rotation,
        position_covariance=np.tile(1e-6 * np.eye(3), (count, 1, 1)),
        velocity=zero,
        velocity_covariance=np.tile(1e-6 * np.eye(3), (count, 1, 1)),
        spin=zero,
        arm=arm,
        loaded=np.ones(count, dtype=bool),
        ground=heights if ground else np.full(count, np.nan),
    )


@pytest.mark.parametrize("seed", range(4))
def test_errors_move_as_differences_do(seed):
    filter, rng, dt, small = make_filter(), np.random.default_rng(seed), 1e-4, 1e-5
    state, gyro, accel = random_state(filter, rng), rng.normal(size=3), 5.0 * rng.normal(size=3)
    rate = (filter.transition(state, gyro - state.gyro_bias, dt) - np.eye(filter.size)) / dt
    for k in range(filter.size):
        moved = []
        for sign in (1.0, -1.0):
            truth = filter.moved(state, -sign * small * np.eye(filter.size)[k])
            after, before = (filter.propagate(s, dt, gyro, accel) for s in (state, truth))
            moved.append(sign * (error_of(filter, after, before) - error_of(filter, state, truth)))
        np.testing.assert_allclose(sum(moved) / (2.0 * small * dt), rate[:, k], atol=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_feet_show_of_the_errors_what_differences_do(seed):
    filter, rng, small = make_filter(), np.random.default_rng(seed), 1e-5
    state = random_state(filter, rng)
    _, design, _ = filter.innovation(state, shown(state), [0, 1, 2, 3])
    for k in range(filter.size):
        off = []
        for sign in (1.0, -1.0):
            truth = filter.moved(state, -sign * small * np.eye(filter.size)[k])
            off.append(sign * filter.innovation(state, shown(truth, arms=False), [0, 1, 2, 3])[0])
        np.testing.assert_allclose(sum(off) / (2.0 * small), design[:, k], atol=1e-3)


def test_a_mean_over_time_moves_as_many_short_ones_do():
    """Rotation, velocity and position of an even turn and force, against small steps."""
    filter, rng = make_filter(), np.random.default_rng(0)
    state, gyro, accel = random_state(filter, rng), np.array([1.0, -2.0, 0.5]), np.array([3.0, -1.0, 12.0])
    once, fine = filter.propagate(state, 0.01, gyro, accel), state
    for k in range(1000):
        fine = filter.propagate(fine, 1e-5 * (k + 1), gyro, accel)
    for name in ("rotation", "velocity", "position"):
        np.testing.assert_allclose(getattr(once, name), getattr(fine, name), atol=2e-5)


@pytest.mark.parametrize(("ground", "hidden"), [(False, 4), (True, 3)])
def test_yaw_and_position_alone_are_hidden(ground, hidden):
    """The errors that no measurement shows are yaw and position; the height of known ground shows one of them."""
    filter, rng = make_filter(), np.random.default_rng(1)
    state = replace(random_state(filter, rng), foot_spin=np.zeros((4, 3)))
    through, rows = np.eye(filter.size), []
    for k in range(40):
        gyro, accel = 3.0 * rng.normal(size=3), 10.0 * rng.normal(size=3)
        rows.append(filter.innovation(state, shown(state, ground=ground), [0, 1, 2, 3])[1] @ through)
        through = filter.transition(state, gyro - state.gyro_bias, 0.02) @ through
        state = filter.propagate(state, 0.02 * (k + 1), gyro, accel)
    rows, yaw = np.vstack(rows), np.zeros(filter.size)
    yaw[2] = 1.0
    np.testing.assert_allclose(rows @ yaw, 0.0, atol=1e-9)
    for axis in range(3 if not ground else 2):
        move = np.zeros(filter.size)
        move[6 + axis : 9 + 12 : 3] = 1.0
        np.testing.assert_allclose(rows @ move, 0.0, atol=1e-9)
    values = np.linalg.svd(rows / np.linalg.norm(rows, axis=0).clip(1e-9), compute_uv=False)
    assert (values < 1e-9 * values[0]).sum() == hidden


class Walk:
    """A base that sways over feet that stand, two of them at a time, and what its sensors show."""

    def __init__(self, seed, *, filter, seconds, still=False, slide=0.0, dt=DT):
        rng = np.random.default_rng(seed)
        known, times = filter._estimate, np.arange(round(seconds / dt) + 1) * dt
        phase, size = rng.uniform(0.0, 6.0, (2, 3)), 0.0 if still else 1.0
        wave = np.sin(7.0 * times[:, None, None] + phase) * (1.0 - np.exp(-times / 0.1))[:, None, None]
        self.rotation = Rotation.from_rotvec(size * 0.15 * wave[:, 0]) * Rotation.from_euler("z", 0.3)
        velocity = size * 0.4 * wave[:, 1]
        self.velocity, self.times = velocity, times
        self.position = np.vstack([np.zeros(3), np.cumsum(0.5 * dt * (velocity[1:] + velocity[:-1]), axis=0)])
        self.position[:, 2] += 0.3
        turn = (self.rotation[:-1].inv() * self.rotation[1:]).as_rotvec()
        middle = self.rotation[:-1] * Rotation.from_rotvec(0.5 * turn)
        force = middle.inv().apply(np.diff(velocity, axis=0) / dt - GRAVITY)
        self.bias = rng.normal(size=(2, 3)) * [[known.imu.gyro_bias], [known.imu.accel_bias]]
        noise = rng.normal(size=(2, *turn.shape)) / np.sqrt(dt)
        self.gyro = turn / dt + self.bias[0] + known.imu.gyro * noise[0]
        self.accel = force + self.bias[1] + known.imu.accel * noise[1]
        self.spin = np.vstack([turn / dt, turn[-1:] / dt])
        self._rng, self._slide, self._known = rng, slide, known
        self._feet = FEET + [0.0, 0.0, 0.3]
        self._tilt = rng.normal(0.0, known.start.tilt, 2)

    def start(self, filter):
        """The estimate at the start, its tilt off."""
        turn = matrix(np.array([*self._tilt, 0.0]))
        return filter.start(0.0, turn @ self.rotation[0].as_matrix(), self.position[0])

    def feet(self, k, *, ground=np.nan):
        """What joints show at step k."""
        at, rotation = self._feet.copy(), self.rotation[k].as_matrix()
        moved = np.zeros((4, 3))
        at[0, 0] += self._slide * self.times[k]
        moved[0, 0] = self._slide
        spread, fast = self._known.kinematics, 0.02
        position = (at - self.position[k]) @ rotation
        velocity = (moved - self.velocity[k]) @ rotation - cross(self.spin[k], position)
        turns = np.arange(4) % 3 == 0 if int(self.times[k] / 0.3) % 2 else np.arange(4) % 3 != 0
        loaded = turns if not self._slide else np.ones(4, dtype=bool)
        return FeetMeasured(
            position=position + self._rng.normal(0.0, spread, (4, 3)),
            position_covariance=np.tile(spread**2 * np.eye(3), (4, 1, 1)),
            velocity=velocity + self._rng.normal(0.0, fast, (4, 3)),
            velocity_covariance=np.tile(fast**2 * np.eye(3), (4, 1, 1)),
            spin=np.tile(-self.spin[k], (4, 1)),
            arm=np.zeros((4, 3)),
            loaded=loaded,
            ground=np.full(4, ground),
        )

    def run(self, filter, **keys):
        """Estimates after every step."""
        state = filter.correct(self.start(filter), self.feet(0, **keys))
        for k in range(1, len(self.times)):
            state = filter.propagate(state, self.times[k], self.gyro[k - 1], self.accel[k - 1])
            state = filter.correct(state, self.feet(k, **keys))
            yield k, state

    def error(self, k, state):
        """Errors of rotation, velocity and position ``[9]``, and of biases ``[6]``."""
        turn = state.rotation @ self.rotation[k].as_matrix().T
        base = state.velocity - turn @ self.velocity[k], state.position - turn @ self.position[k]
        biases = np.ravel([state.gyro_bias, state.accel_bias]) - self.bias.ravel()
        return np.concatenate([Rotation.from_matrix(turn).as_rotvec(), *base, biases])


def test_errors_are_as_large_as_the_filter_says():
    """Normalized squared errors of tilt, velocity and biases over seeds, in the interval that chance leaves them."""
    filter, seeds = make_filter(slip=0.002, imu={"gyro_walk": 0.0, "accel_walk": 0.0}), 10
    shown_of = [0, 1, *range(3, 6), *range(filter.size - 6, filter.size)]
    found = []
    for seed in range(seeds):
        walk = Walk(seed, filter=filter, seconds=1.0, dt=0.005)
        *_, (k, state) = walk.run(filter)
        error = walk.error(k, state)
        found.append(
            [
                error[rows] @ np.linalg.solve(state.covariance[np.ix_(places, places)], error[rows])
                for rows, places in (([0, 1, 3, 4, 5], [0, 1, 3, 4, 5]), ([*range(9, 15)], shown_of[-6:]))
            ]
        )
    for values, size in zip(np.transpose(found), (5, 6), strict=True):
        low, high = chi2.ppf([0.005, 0.995], seeds * size) / seeds
        assert low < values.mean() < high


@pytest.mark.parametrize("seed", range(3))
def test_standing_still_finds_biases_and_drifts_nowhere(seed):
    filter = make_filter()
    walk = Walk(seed, filter=filter, seconds=5.0, still=True, dt=0.01)
    walk.feet = lambda k, feet=walk.feet, **keys: replace(feet(k, **keys), loaded=np.ones(4, dtype=bool))
    errors = np.array([walk.error(k, state) for k, state in walk.run(filter, ground=0.0)])
    late = errors[len(errors) // 2 :]
    assert np.abs(late[:, V]).max() < 0.01
    assert np.abs(late[:, PHI][:, :2] - late[0, PHI][:2]).max() < 0.002  # rad
    assert np.abs(late[:, P] - late[0, P]).max() < 0.01
    assert np.abs(late[-1, 9:11]).max() < 5e-4  # the gyroscope's, about horizontal axes
    assert abs(late[-1, 14]) < 0.01  # the accelerometer's, upright


def test_a_foot_that_slides_moves_nothing():
    filter = make_filter()
    walk = Walk(0, filter=filter, seconds=1.0, slide=0.6, dt=0.005)
    errors, contact = zip(*((walk.error(k, state), state.contact) for k, state in walk.run(filter)), strict=True)
    assert np.abs(np.array(errors)[50:, V]).max() < 0.03
    assert np.mean([row[0] for row in contact]) < 0.05
    assert np.mean([row[1:] for row in contact]) > 0.9


def test_the_covariance_stays_symmetric_and_positive():
    filter = make_filter()
    for _, state in Walk(3, filter=filter, seconds=0.5).run(filter):
        standing = np.repeat(state.contact, 3)
        places = np.r_[0:9, 9 + np.flatnonzero(standing), filter.size - 6 : filter.size]
        covariance = state.covariance[np.ix_(places, places)]
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-9)
        assert np.linalg.eigvalsh(covariance).min() > -1e-12
