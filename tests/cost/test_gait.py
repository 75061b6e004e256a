# SPDX-License-Identifier: Apache-2.0
"""A gait asks of each foot, in its turn, to be lifted and put down again."""

import numpy as np
import pytest
from rollouts import SHAPE, Rollouts

from warpmpc import SceneError
from warpmpc.engine.protocol import TimeGrid

FEET = ["base/tip", "box", "base/centre"]
GAIT = {"term": "gait_residual", "feet": FEET, "phases": [0.0, 0.5, 0.8], "cadence": 3.0}


def lifted(time: np.ndarray, phase: float, swing: float, cadence: float = 3.0) -> np.ndarray:
    """Share of the step's height at times [s], in float64."""
    x = np.mod(cadence * time - phase, 1.0) / swing
    return np.where(x < 1.0, 4.0 * x * (1.0 - x), 0.0)


def times(r: Rollouts, start: np.ndarray) -> np.ndarray:
    """When the steps end ``[T, W]`` [s], of environments that are observed at ``start`` [E]."""
    ends = TimeGrid.of(r.scene).t[1 : SHAPE.horizon + 1]
    return ends[:, None] + np.repeat(start, SHAPE.rollouts)


def test_feet_are_lifted_in_their_turn_on_the_clock_of_the_observations():
    r = Rollouts(
        {**GAIT, "height": [0.3, "step", 0.2], "swing": 0.4, "stand": 0.05},
        {**GAIT, "height": "step", "norm": {"kind": "smooth_abs", "p": 0.1}},
        scalar={"step": 0.5},
    )
    start = np.array([0.13, 7.41], dtype=np.float32)
    r.state.start.assign(start)
    z = np.stack([r.pose(foot)[0][..., 2] for foot in FEET], axis=-1)
    time = times(r, start.astype(float))
    first = np.stack([h * lifted(time, p, 0.4) for h, p in zip((0.3, 0.5, 0.2), GAIT["phases"], strict=True)], axis=-1)
    assert (first > 0.05).any(axis=(0, 1)).all()
    assert (first == 0.0).any(axis=(0, 1)).all()
    np.testing.assert_allclose(r.cost(0), 0.5 * ((z - 0.05 - first) ** 2).sum(-1), rtol=1e-4, atol=1e-5)
    d = z - 0.5 * np.stack([lifted(time, p, 0.5) for p in GAIT["phases"]], axis=-1)
    np.testing.assert_allclose(r.cost(1), (np.sqrt(d**2 + 0.01) - 0.1).sum(-1), rtol=1e-4, atol=1e-5)


def test_a_height_of_zero_stands_whatever_the_time_is():
    r = Rollouts({**GAIT, "height": "step"}, scalar={"step": 0.0})
    before = r.cost()
    r.state.start.assign(np.array([0.11, 0.22], dtype=np.float32))
    np.testing.assert_array_equal(r.cost(), before)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"phases": [0.0, 0.5]}, r"cost\.gait_residual\.phases.*one phase for each of the 3 feet"),
        ({"feet": ["base/tpi", "box", "wall"]}, r"cost\.gait_residual\.feet.*Did you mean 'base/tip'"),
        ({"height": "stap"}, r"cost\.gait_residual\.height.*Did you mean 'step'"),
        ({"height": [0.1, 0.2]}, r"cost\.gait_residual\.height.*1 or 3 values"),
        ({"swing": 1.0}, r"cost\.gait_residual\.swing"),
        ({"feet": []}, r"cost\.gait_residual\.feet"),
    ],
)
def test_mistakes_in_a_gait_are_named(keys, message):
    with pytest.raises(SceneError, match=message):
        Rollouts({**GAIT, "height": 0.1, **keys}, scalar={"step": 0.5})
