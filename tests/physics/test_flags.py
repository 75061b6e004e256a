# SPDX-License-Identifier: Apache-2.0
"""Flags and other options of a model: heeded, without effect, or refused by name."""

import itertools
import logging

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from fused_models import controls, starts
from fused_steps import public_differences, visit

from warpmpc.physics import rollout
from warpmpc.physics.unsupported import HEEDED, REFUSED, WITHOUT_EFFECT, missing

ENUMS = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}
BITS = [
    (field, name, int(bit)) for field, kind in ENUMS.items() for name, bit in kind.__members__.items() if "BL_" in name
]
CRAMPED = """
<mujoco>
  <option timestep="0.005" iterations="100" tolerance="1e-10"/>
  <worldbody>
    <geom type="plane" size="3 3 .1"/>
    <body pos="0 0 .12">
      <joint name="a" axis="0 1 0" damping=".5" armature=".02" range="-20 20" stiffness="2" frictionloss=".1"/>
      <geom type="capsule" fromto="0 0 0 .4 0 0" size=".05"/>
      <body pos=".4 0 0">
        <joint name="b" axis="0 0 1" damping=".3" armature=".01" solreflimit=".001 1" range="-5 5"/>
        <joint name="c" axis="0 1 0" damping=".3" armature=".01"/>
        <geom type="box" size=".1 .05 .08" pos=".13 .01 0"/>
      </body>
    </body>
    <body pos="-.4 0 .1" euler="5 0 0"><freejoint/><geom type="box" size=".2 .1 .095" condim="4" margin=".01"/></body>
  </worldbody>
  <equality><joint joint1="b" joint2="c" polycoef=".05 .5 0 0 0"/></equality>
  <actuator>
    <position joint="a" kp="20" ctrlrange="-.2 .2" group="1"/>
    <general joint="c" dyntype="filter" dynprm=".05" gainprm="3" actrange="-.1 .1" actlimited="true" group="2"/>
  </actuator>
</mujoco>
"""


def test_every_flag_of_mujoco_is_classified_once():
    known = [*HEEDED, *WITHOUT_EFFECT, *REFUSED]
    assert len(known) == len(set(known))
    assert {name.removeprefix("mj") for _, name, _ in BITS} <= set(known), "a new flag: heed it, or refuse it"


@pytest.mark.parametrize(("field", "name", "bit"), BITS, ids=[name for _, name, _ in BITS])
def test_a_flag_is_refused_by_its_name_or_not_at_all(field, name, bit):
    model = mujoco.MjModel.from_xml_string(CRAMPED)
    setattr(model.opt, field, bit)
    assert missing(model) == (f"physics of the flags {name[2:]}" if name[2:] in REFUSED else None)


def test_flags_that_nobody_knows_yet_are_refused():
    for field, kind in ENUMS.items():
        model = mujoco.MjModel.from_xml_string(CRAMPED)
        setattr(model.opt, field, 1 << 27)
        assert missing(model) == f"physics of the flags {kind.__name__} {1 << 27}"


def agree(model, worlds=8, steps=24):
    """Single steps agree with MuJoCo's from states that it visits."""
    q, v = starts(model, worlds, seed=1)
    states = visit([model], q, v, controls(model, steps, worlds, seed=2), every=3)
    found = public_differences(model, states)
    steady = states.edge < 1e-4
    assert steady.mean() > 0.8, found
    most = found.v.max(axis=1)[steady]
    assert np.median(most) <= 5e-6, found
    scale = 1.0 + np.abs(states.next_v).max(axis=1)
    assert (most <= (1e-4 * scale + 5.0 * states.edge)[steady]).all(), found


HEEDED_TOGETHER = [
    # what has an effect that others hide is in another row
    ("EQUALITY", "FRICTIONLOSS", "SPRING", "CLAMPCTRL", "FILTERPARENT", "MULTICCD", "ISLAND", "ENERGY"),
    ("LIMIT", "GRAVITY", "DAMPER", "ACTUATION", "NATIVECCD", "OVERRIDE", "FWDINV"),
    ("CONTACT", "REFSAFE", "EULERDAMP", "WARMSTART", "MIDPHASE", "INVDISCRETE"),
    ("CONSTRAINT", "SENSOR", "AUTORESET"),
]


@pytest.mark.parametrize("names", HEEDED_TOGETHER, ids="+".join)
def test_flags_are_heeded(names):
    model = mujoco.MjModel.from_xml_string(CRAMPED)
    model.opt.o_margin, model.opt.o_solref[:], model.opt.o_friction[:2] = 0.02, (0.05, 0.7), 0.3
    for field, name, bit in BITS:
        if name.partition("_")[2] in names:
            setattr(model.opt, field, getattr(model.opt, field) | bit)
    agree(model)


def test_flags_above_are_all_that_are_heeded():
    together = set(itertools.chain(*HEEDED_TOGETHER))
    assert {name.partition("_")[2] for name in HEEDED | WITHOUT_EFFECT} == together


@pytest.mark.parametrize("off", [1 << 1, 1 << 2 | 1 << 5])
def test_groups_of_actuators_may_be_off(off):
    model = mujoco.MjModel.from_xml_string(CRAMPED)
    model.opt.disableactuator = off
    agree(model)


@pytest.mark.parametrize(("solver", "cone"), [("CG", "elliptic"), ("PGS", "pyramidal")])
def test_newtons_method_stands_in_for_other_solvers_and_says_so(solver, cone, caplog):
    model = mujoco.MjModel.from_xml_string(CRAMPED)
    model.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{solver}")
    model.opt.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}")
    agree(model)  # MuJoCo's solver goes on until nothing changes there
    model.opt.iterations = 3  # too few for it, enough here
    worlds = 4
    start = np.hstack([np.zeros((worlds, 1)), *starts(model, worlds), np.zeros((worlds, model.na))])
    with caplog.at_level(logging.INFO, "warpmpc"), rollout.Rollout(fall_back=False) as pool:
        found, _ = pool.rollout(model, mujoco.MjData(model), start, np.zeros((worlds, 10, model.nu)))
    model.opt.iterations, model.opt.solver = 100, mujoco.mjtSolver.mjSOL_NEWTON
    expected, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), start, np.zeros((worlds, 10, model.nu)))
    np.testing.assert_allclose(found, expected, atol=2e-4)
    assert any(f"in place of the model's {solver}" in record.getMessage() for record in caplog.records)
