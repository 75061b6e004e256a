# SPDX-License-Identifier: Apache-2.0
"""Friction about the normal and the tangents, pyramidal and elliptic cones: single steps are those of MuJoCo C."""

import mujoco
import numpy as np
import pytest
from cones import ELLIPSE, PYRAMID, rubbing
from fused_models import CONTACTS, compile_model, controls, starts
from fused_steps import step_differences, visit
from shared.plain_rollout import PlainRollout

STEADY = 1e-4
"""States where MuJoCo C's own step changes more by rounding are left out [m/s, rad/s]."""


def visited(model: mujoco.MjModel, seed: int):
    """States that a model visits under random controls."""
    q, v = starts(model, 12, seed=seed)
    return visit([model], q, v, controls(model, 100, 12, seed=seed), every=4)


CASES = [
    pytest.param(PYRAMID, 1.0, (4, 6, 3), id="pyramids"),
    pytest.param(PYRAMID, 5.0, (4,), id="pyramids about the normal, impratio", marks=pytest.mark.slow),
    pytest.param(ELLIPSE, 1.0, (3,), id="ellipses along the tangents", marks=pytest.mark.slow),
    pytest.param(ELLIPSE, 10.0, (3, 4, 6), id="ellipses, impratio"),
    pytest.param(ELLIPSE, 0.5, (6,), id="ellipses of five", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("cone", "impratio", "condims"), CASES)
def test_single_steps_with_friction_of_all_kinds_are_those_of_mujoco(cone, impratio, condims, seed):
    model = rubbing(cone, impratio, condims)
    states = visited(model, seed)
    found = step_differences(model, states, lanes=4)
    steady = states.edge < STEADY
    most = found.v.max(axis=1)[steady]
    print(f"\n{found}")
    assert steady.mean() > 0.97
    assert np.median(found.v) <= 1e-6, found
    assert np.percentile(most, 99) <= 5e-5, found
    assert most.max() <= 1e-3, found
    plain = compile_model(CONTACTS)  # without these kinds of friction these are other steps
    plain.opt.integrator = model.opt.integrator
    data, other = mujoco.MjData(model), mujoco.MjData(plain)
    apart = 0.0
    for q, v in zip(states.q[::8], states.v[::8], strict=True):
        for m, d in ((model, data), (plain, other)):
            mujoco.mj_resetData(m, d)
            d.qpos[:], d.qvel[:] = q, v
            mujoco.mj_step(m, d)
        apart = max(apart, np.abs(data.qvel - other.qvel).max())
    assert apart > 1e-2


@pytest.mark.parametrize("cone", [PYRAMID, ELLIPSE])
def test_a_lane_does_not_depend_on_its_neighbours(cone):
    model = rubbing(cone, 10.0 if cone == ELLIPSE else 1.0, (3, 4, 6) if cone == ELLIPSE else (4, 6, 3))
    q, v = starts(model, 24, seed=5)
    u = controls(model, 20, 24, seed=5)
    engine = PlainRollout(model, 24, 20, lanes=4)
    clean = [x.copy() for x in engine(q, v, u)]
    order = np.random.default_rng(0).permutation(24)
    mixed = engine(q[order], v[order], u[:, order])
    for x, y in zip(clean, mixed, strict=True):
        np.testing.assert_array_equal(x[:, order], y)


PAIRED = """
<mujoco><option timestep="0.004" integrator="implicitfast" iterations="100" tolerance="1e-8" cone="{cone}"/><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <body pos="0 0 .12"><freejoint/><geom name="box" type="box" size=".2 .15 .1" mass="1"/></body>
  <body pos="1 0 .12"><freejoint/><geom name="ball" type="sphere" size=".1" mass="1"/></body></worldbody>
<contact><pair geom1="floor" geom2="box" condim="3" friction="0.9 0.2" solreffriction="0.06 1.2"/>
  <pair geom1="floor" geom2="ball" condim="{condim}" friction="0.8 0.1 0.02 0.01 0.05"
    solreffriction="-20 -30"/></contact></mujoco>"""


@pytest.mark.parametrize(
    ("cone", "condim"), [pytest.param("pyramidal", 3, marks=pytest.mark.slow), ("pyramidal", 6), ("elliptic", 6)]
)
def test_friction_that_differs_along_the_tangents_is_that_of_mujoco(cone, condim):
    model = mujoco.MjModel.from_xml_string(PAIRED.format(cone=cone, condim=condim))
    states = visited(model, 0)
    assert (states.rows > 0).mean() > 0.5
    found = step_differences(model, states, lanes=4)
    steady = states.edge < STEADY
    assert np.median(found.v) <= 1e-6, found
    assert found.v.max(axis=1)[steady].max() <= 5e-4, found
