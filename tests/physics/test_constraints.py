# SPDX-License-Identifier: Apache-2.0
"""Friction of joints, equalities, tendons, activations, thrusters, explicit pairs and media against MuJoCo C."""

import functools

import mujoco
import numpy as np
import pytest
from constraint_models import EQUALITIES, PAIRS, SWIMMERS, TENDONS
from fused_models import compile_model, controls, starts
from fused_steps import step_differences, visit
from needs import need, needs
from shared.models import hand_with_block, spread
from shared.plain_rollout import PlainRollout
from warp_lanes import LaneRollout

from warpmpc.physics.model import PhysicsModel
from warpmpc.physics.unsupported import missing

MODELS = {"equalities": EQUALITIES, "tendons": TENDONS, "pairs": PAIRS, "swimmers": SWIMMERS}


@functools.cache
def visited(name: str, integrator: str, seed: int = 0):
    """A model, and states that it visits under random controls."""
    model = compile_model(MODELS[name], integrator)
    worlds, steps = (16, 90) if name == "pairs" else (8, 60)  # few contacts without friction change sides in a step
    q, v = starts(model, worlds, seed=seed)
    return model, visit([model], q, v, controls(model, steps, worlds, seed=seed), every=3)


@pytest.mark.parametrize(
    ("name", "integrator"),
    [
        *((name, "implicitfast") for name in MODELS if name != "swimmers"),
        ("swimmers", "Euler"),
        *(pytest.param(name, "Euler", marks=pytest.mark.slow) for name in MODELS if name != "swimmers"),
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_single_steps_are_those_of_mujoco(name, integrator, seed):
    """Activations too: `step_differences` compares them."""
    model, states = visited(name, integrator, seed)
    found = step_differences(model, states, lanes=4)
    most = found.v.max(axis=1)[states.edge < 1e-4]
    assert len(most) > 0.97 * len(states.edge), found
    assert most.max() <= (3e-4 if name == "pairs" else 1e-4), found  # where a corner comes into the margin
    assert np.percentile(most, 99) <= 5e-5, found
    assert np.median(found.v) <= 1e-6, found


def test_every_kind_of_row_is_there_and_none_is_refused():
    for text in MODELS.values():
        assert missing(compile_model(text)) is None
    model = compile_model(EQUALITIES)
    kinds = [int(model.eq_type[row.index]) for row in PhysicsModel(model).constraints if row.kind == "equality"]
    assert set(kinds) == {int(getattr(mujoco.mjtEq, f"mjEQ_{kind}")) for kind in ("CONNECT", "WELD", "JOINT")}
    assert len(kinds) == model.neq - 1  # one is not active
    assert {row.kind for row in PhysicsModel(compile_model(TENDONS)).constraints} == {"equality", "limit", "friction"}


@pytest.mark.parametrize("name", MODELS)
def test_neighbours_do_not_change_a_bit(name):
    model, states = visited(name, "Euler" if name == "swimmers" else "implicitfast")
    few, rng = 8, np.random.default_rng(0)
    chosen, others = np.arange(few), rng.permutation(len(states.q))[: 3 * few]
    order = rng.permutation(4 * few)
    rows = np.concatenate([chosen, others])[order]
    engine, alone = PlainRollout(model, 4 * few, 3, lanes=4), PlainRollout(model, few, 3, lanes=4)
    mixed = engine(*_starts(states, rows))
    own = alone(*_starts(states, chosen))
    places = [int(np.flatnonzero(order == k)[0]) for k in range(few)]
    for a, b in zip(mixed, own, strict=True):
        np.testing.assert_array_equal(a[:, places], b)


def _starts(states, rows):
    return states.q[rows], states.v[rows], np.repeat(states.control[None, rows], 3, axis=0), states.act[rows]


@needs("g++")
@pytest.mark.parametrize("name", MODELS)
def test_lanes_of_a_warp_do_the_same(name, tmp_path_factory):
    model, states = visited(name, "Euler" if name == "swimmers" else "implicitfast")
    rows = np.arange(4)
    expected = [x.copy() for x in PlainRollout(model, 4, 3, lanes=4)(*_starts(states, rows))]
    lanes = LaneRollout(model, 4, 3, folder=tmp_path_factory.getbasetemp())
    found = []
    for order in (0, 2, 4 * 5 + 1):
        lanes.order = order
        found.append([x.copy() for x in lanes(*_starts(states, rows))])
    for other in found[1:]:
        for x, y in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(x, y)
    for x, y in zip(found[0], expected, strict=True):
        np.testing.assert_allclose(x, y, atol=5e-4)


def test_worlds_of_their_own_masses_are_softened_as_mujoco_does():
    """Inverse inertias of constraints differ between worlds with the bodies' masses."""
    nominal = compile_model(EQUALITIES)
    models, rng = [], np.random.default_rng(0)
    for _ in range(6):
        model = compile_model(EQUALITIES)
        factor = rng.uniform(0.6, 1.6, model.nbody)
        model.body_mass[:] *= factor
        model.body_inertia[:] *= factor[:, None]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        models.append(model)
    names = ("body_mass", "body_inertia", "body_invweight0", "dof_invweight0")
    arrays = {name: np.array([getattr(model, name) for model in models]) for name in names}
    q, v = starts(nominal, 6)
    states = visit(models, q, v, controls(nominal, 60, 6), every=3)
    found = step_differences(nominal, states, arrays=arrays)
    assert found.v.max(axis=1)[states.edge < 1e-4].max() <= 1e-4, found


FLAGS = (
    ("tendons", "Euler", ("EULERDAMP",)),
    ("tendons", "implicitfast", ("DAMPER",)),
    ("tendons", "implicitfast", ("SPRING", "LIMIT", "FRICTIONLOSS", "EQUALITY", "CLAMPCTRL")),
    ("swimmers", "Euler", ("SPRING", "DAMPER")),
    ("equalities", "implicitfast", ("CONSTRAINT", "GRAVITY")),
)


@pytest.mark.parametrize(
    ("name", "integrator", "parts"),
    [FLAGS[0], *(pytest.param(*flags, marks=pytest.mark.slow) for flags in FLAGS[1:])],
)
def test_parts_of_the_physics_are_left_out_as_mujoco_does(name, integrator, parts):
    model = compile_model(MODELS[name], integrator)
    for part in parts:
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}"))
    q, v = starts(model, 8)
    states = visit([model], q, v, controls(model, 40, 8), every=4)
    found = step_differences(model, states, lanes=4)
    assert found.v.max(axis=1)[states.edge < 1e-4].max() <= 1e-4, found


@pytest.mark.slow
def test_single_steps_of_a_hand_are_those_of_mujoco():
    """The Shadow hand with a block: 44 limits of tendons, 24 joints with friction, contacts without torsion."""
    need("gymnasium_robotics")
    model = hand_with_block()
    for condim in (model.geom_condim, model.pair_dim):
        condim[:] = np.minimum(condim, 3)
    q, v, u = spread(model, 12, seconds=0.3)
    states = visit([model], q, v, np.repeat(u[None], 60, axis=0), every=4)
    found = step_differences(model, states)
    assert states.contacts.mean() > 1.0
    assert states.rows.mean() > 40.0
    most = found.v.max(axis=1)
    assert (most <= 1e-4 + 2.0 * states.edge).mean() >= 0.98, found
    assert np.median(found.v) <= 1e-6, found
