# SPDX-License-Identifier: Apache-2.0
"""The engine `fused` against MuJoCo C: single steps from states that MuJoCo visits.

The reference solves to the end (`fused_steps.exact`); floats then agree to 1e-6 of typical velocities. Where MuJoCo C
itself jumps when its state moves by the rounding of a float, because a contact begins or ends there, nothing can agree:
these states are counted and left out.

Slow ones by hand: pytest -m slow tests/physics/test_physics_agreement.py
"""

import functools

import numpy as np
import pytest
from fused_models import CONTACTS, DYNAMICS, compile_model, controls, starts
from fused_scenes import Comparison
from fused_steps import step_differences, visit
from shared.models import OWN, spread
from shared.plain_rollout import PlainRollout

JUMPS = 1e-4
"""States where MuJoCo C's own step changes so much by rounding are left out [m/s, rad/s]."""


@functools.cache
def visited(text: str, integrator: str = "implicitfast"):
    """A model, and states that it visits under random controls."""
    model = compile_model(text, integrator)
    q, v = starts(model, 12)
    return model, visit([model], q, v, controls(model, 120, 12), every=4)


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


@pytest.mark.slow
@pytest.mark.parametrize("name", OWN)
def test_single_steps_of_robots_are_those_of_mujoco(name):
    model = OWN[name]()
    q, v, u = spread(model, 24, seconds=0.2)
    found = step_differences(model, visit([model], q, v, np.repeat(u[None], 120, axis=0), every=3))
    assert (found.visited.rows > 0).mean() > 0.5, found
    most = found.v.max(axis=1)

    assert np.median(found.v) <= 2e-6, found
    # the light limbs of the humanoid make much of the rounding of a state
    assert (most <= 1e-4 + 2.0 * found.visited.edge).mean() >= 0.98, found


@pytest.mark.parametrize("lanes", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (8, 16))])
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


SCENES = ["omni_push_box", "panda_push"]
MORE = ["omni_push_sphere", "diff_push_box", "panda_push_objects", "panda_reach", "point_reach", "mobile_pick"]
MORE += ["push_t", "humanoid_stand"]
EVERY = [*SCENES, *(pytest.param(name, marks=pytest.mark.slow) for name in MORE)]
"""The shipped scenes with physics; few by default, since each is a model to compile."""
MEETING = {"point_reach": ["obstacle.sphere_1.position=[0.605, 0.03, 0.0]"]}
"""Changes that bring robots to touch anything where their planners know how not to."""


@pytest.mark.parametrize("name", EVERY)
def test_single_steps_of_shipped_scenes_are_those_of_mujoco(name):
    """Randomized worlds, from states that rollouts visit in closed loop."""
    comparison = Comparison(name, overrides=MEETING.get(name, ()))
    varied = set(comparison.fused.model.columns.arrays)
    assert not comparison.scene.randomize or {"body_mass", "body_inertia", "geom_friction"} <= varied
    assert name != "omni_push_box" or {"geom_size", "geom_rbound", "body_invweight0"} <= varied
    found = comparison.steps()
    steady = found.edge < JUMPS
    assert steady.mean() > 0.95, found
    assert not comparison.pairs or (found.strength > 0.0).any(), found
    for name in ("v", "twist"):
        # floats are relative: of the speed of the fastest joint where that is above one, such as wheels
        values = (getattr(found, name) / np.maximum(1.0, found.speed))[steady]
        assert np.median(values) <= 1e-5, found
        assert (values > 1e-4).mean() <= 0.02, found
        assert values.max() <= 2e-3, found
    for name in ("q", "pose"):
        assert getattr(found, name)[steady].max() <= 2e-5, found
    assert (found.force[steady] <= 1e-3 + 1e-4 * found.strength[steady]).mean() >= 0.98, found
    assert found.force[steady].max() <= 0.1, found


@pytest.mark.parametrize("name", EVERY)
def test_rollouts_of_shipped_scenes_end_where_those_of_mujoco_do(name):
    """As well as MuJoCo C agrees with itself when its start moves by a millionth."""
    ours, own = Comparison(name, states=24, horizon=12, substeps=2, seconds=2.0).ends()
    ours, own = (np.percentile(distance, (50, 90)) for distance in (ours, own))
    assert (ours <= 2.0 * own).all(), (ours, own)
