# SPDX-License-Identifier: Apache-2.0
"""The engine `fused` against MuJoCo C on random small models.

Trees, joints, shapes, drives, contacts, friction of joints, equalities, tendons and activations.

Slow ones by hand: pytest -m slow tests/physics/test_random_models.py
"""

from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from fused_models import controls, starts
from fused_steps import public_differences, step_differences, visit
from hypothesis import HealthCheck, Phase, given, note, settings
from random_models import models

from warpmpc.physics.unsupported import missing

# every example is a model to compile: no search for a smaller one
quiet = settings(deadline=None, suppress_health_check=list(HealthCheck), phases=(Phase.generate,))


def check(text: str, take_steps: Callable = step_differences, **how: int) -> None:
    model = mujoco.MjModel.from_xml_string(text)
    assert missing(model) is None
    worlds = 6
    q, v = starts(model, worlds, seed=1)
    states = visit([model], q, v, controls(model, 40, worlds, seed=2), every=4)
    # models may begin deep in one another or in the floor, where stiff rows of little leverage multiply rounding
    sane = (np.abs(states.v).max(axis=1) < 50.0) & (states.depth < 0.03)
    found = take_steps(model, states, **how)
    note(text)
    note(str(found))
    # what MuJoCo C itself makes of the rounding of the state, and ours of what it computes with it
    scale = 1.0 + np.abs(states.next_v).max(axis=1)
    good = found.v.max(axis=1) <= 1e-4 * scale + 20.0 * states.edge
    assert good[sane].mean() >= 0.97 if sane.any() else True, found
    if sane.any():  # pressed deep into the floor, rounding shows: then MuJoCo C's own answer to a nudge is of its size
        likely = 5e-6 * scale + 5.0 * states.edge
        assert np.median((found.v.max(axis=1) / likely)[sane]) <= 1.0, found


@settings(quiet, max_examples=3)
@given(models())
def test_random_models_step_as_in_mujoco(text):
    check(text, lanes=1)


@settings(quiet, max_examples=2)
@given(models())
def test_random_models_step_as_in_mujoco_by_the_public_rollouts(text):
    check(text, public_differences)


@pytest.mark.slow
@pytest.mark.timeout(900)
@settings(quiet, max_examples=80)
@given(models())
def test_many_random_models_step_as_in_mujoco(text):
    check(text, lanes=1)


@pytest.mark.slow
@pytest.mark.timeout(900)
@settings(quiet, max_examples=80)
@given(models())
def test_many_random_models_step_as_in_mujoco_by_the_public_rollouts(text):
    check(text, public_differences)
