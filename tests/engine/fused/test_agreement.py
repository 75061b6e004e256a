# SPDX-License-Identifier: Apache-2.0
"""The engine `fused` against MuJoCo C: single steps from states that MuJoCo visits.

The reference solves to the end (`fused_steps.exact`); floats then agree to 1e-6 of typical velocities. Where MuJoCo C
itself jumps when its state moves by the rounding of a float, because a contact begins or ends there, nothing can agree:
these states are counted and left out.
"""

import functools

import numpy as np
import pytest
from fused_models import CONTACTS, DYNAMICS, compile_model, controls, starts
from fused_steps import step_differences, visit

from warpmpc.engine.fused.plain import PlainRollout

JUMPS = 1e-4
"""States where MuJoCo C's own step changes so much by rounding are left out [m/s, rad/s]."""


@functools.cache
def visited(text: str, integrator: str = "implicitfast"):
    """A model, and states that it visits under random controls."""
    model = compile_model(text, integrator)
    q, v = starts(model, 24)
    return model, visit([model], q, v, controls(model, 120, 24), every=3)


def check(found, *, median: float = 5e-6, p99: float = 5e-5, largest: float = 1e-3) -> None:
    """Velocities agree but for where MuJoCo C jumps."""
    steady = found.visited.edge < JUMPS
    most = found.v.max(axis=1)[steady]
    assert steady.mean() > 0.97, found
    assert np.median(most) <= median, found
    assert np.percentile(most, 99) <= p99, found
    assert most.max() <= largest, found
    assert np.median(found.v) <= 1e-6, found


@pytest.mark.parametrize(
    ("text", "integrator"),
    [
        (DYNAMICS, "implicitfast"),
        (CONTACTS, "implicitfast"),
        pytest.param(DYNAMICS, "Euler", marks=pytest.mark.slow),
        pytest.param(CONTACTS, "Euler", marks=pytest.mark.slow),
    ],
    ids=["joints and drives", "contacts", "joints and drives, euler", "contacts, euler"],
)
def test_single_steps_of_made_up_trees_are_those_of_mujoco(text, integrator):
    model, states = visited(text, integrator)
    assert (states.rows > 0).mean() > 0.5
    check(step_differences(model, states, lanes=4))


@pytest.mark.parametrize("lanes", [1, pytest.param(8, marks=pytest.mark.slow), pytest.param(16, marks=pytest.mark.slow)])
def test_numbers_of_any_width_give_the_same(lanes):
    model, states = visited(CONTACTS)
    worlds, steps = len(states.q), 4
    control = np.repeat(states.control[None], steps, axis=0)
    runs = []
    for width in (4, lanes):
        runs.append(PlainRollout(model, worlds, steps, lanes=width)(states.q, states.v, control)[1])
    steady = states.edge < JUMPS
    apart = np.abs(runs[0][0] - runs[1][0]).max(axis=1)
    assert apart[steady].max() < 1e-4
    assert np.median(apart) < 1e-6  # compilers contract products and sums differently
    # later steps begin where the first ends
    assert np.median(np.abs(runs[0][-1] - runs[1][-1]).max(axis=1)) < 1e-4
