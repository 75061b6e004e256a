# SPDX-License-Identifier: Apache-2.0
"""Models at the edges of single precision roll out as in MuJoCo, as far as rounding lets them, or are refused.

Slow ones by hand: pytest -m slow tests/physics/test_extreme_models.py
"""

import logging

import mujoco
import pytest
from extreme_models import MODELS, apart
from hypothesis import HealthCheck, Phase, given, note, settings

from warpmpc.physics.unsupported import missing

ROUNDING = 1e-3
"""Difference of coordinates that is left to single precision where MuJoCo itself is calm, after 50 steps [m, rad]."""
quiet = settings(deadline=None, suppress_health_check=list(HealthCheck), phases=(Phase.generate,))
WHEEL = """<body pos="0 0 .099"><joint name="turn" axis="0 1 0" damping=".01"/>
  <geom type="sphere" size=".1" mass="1"/></body>"""
TURNTABLE = """<geom type="box" size=".25 .25 .05" pos="1 0 .05"/><body pos="1 0 .128">
  <joint axis="0 0 1" damping=".05"/><geom type="cylinder" size=".2 .03" mass="2"/></body>"""
KNOB = """<geom type="box" size=".02 .3 .3" pos="0 1 1"/><body pos="0 1 1"><joint axis="1 0 0"/>
  <geom type="cylinder" size=".05 .04" euler="0 90 0" mass=".5"/></body>"""
BOX = '<body pos="0 0 .12" euler="3 5 0"><freejoint/><geom type="box" size=".1 .08 .06" mass="1.3" {0}/></body>'
CASES = {
    "joints through centres of mass": WHEEL + TURNTABLE,
    "centres that are one": KNOB,
    "no friction": BOX.format('friction="0 0 0"'),
    "ice": BOX.format('friction=".001 0 0"'),
    "impedance without width": BOX.format('solimp=".5 .99 0" priority="1"'),
    "mixed reference": BOX.format('solref="-100 1" priority="1"'),
    "no damping": BOX.format('solref=".02 0" priority="1"'),
    "no time": BOX.format('solref="0 1" priority="1"'),
}


def scene(bodies: str) -> mujoco.MjModel:
    """A model of bodies on a floor that has no friction set."""
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep=".004"/><worldbody><geom type="plane" size="3 3 .1" friction="0 0 0"/>{bodies}'
        "</worldbody></mujoco>"
    )


@pytest.mark.parametrize("name", CASES)
def test_edges_of_single_precision(name, caplog):
    with caplog.at_level(logging.WARNING, logger="warpmpc"):
        found = apart(scene(CASES[name]))
    assert found.worst <= ROUNDING, found
    lines = [r.getMessage() for r in caplog.records if "solref" in r.getMessage()]
    assert len(lines) == ('solref="' in CASES[name])


LEG = """<body pos="{0} {1} 0"><joint name="h{2}" axis="0 1 0"/>
  <geom size=".02" pos="-.04 0 -.08" mass=".5" contype="0" conaffinity="0"/><body pos="-.08 0 -.16">
  <joint name="k{2}" axis="0 1 0"/><geom size=".03" pos=".08 0 -.16" mass=".25" friction=".8"/></body></body>"""
FEW = """<mujoco><option timestep=".004" iterations="{0}" ls_iterations="{1}" cone="{2}">
<flag warmstart="{3}"/></option><default><joint armature=".01"/></default><worldbody>
<geom type="plane" size="5 5 .1" friction=".6"/>{4}
<body pos=".02 0 .22"><freejoint/><geom type="box" size=".05 .05 .04" mass=".3"/></body>
<body pos="2 0 .345"><freejoint/><geom type="box" size=".2 .1 .05" mass="6" contype="0" conaffinity="0"/>{5}{6}</body>
</worldbody><actuator><position joint="h0" kp="40"/><position joint="k1" kp="40"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("iterations", "searches", "cone", "warm"),
    [
        (1, 4, "pyramidal", "enable"),
        (3, 5, "elliptic", "enable"),
        pytest.param(5, 8, "pyramidal", "disable", marks=pytest.mark.slow),
        pytest.param(19, 4, "elliptic", "disable", marks=pytest.mark.slow),
    ],
)
def test_few_iterations_end_where_those_of_mujoco_do(iterations, searches, cone, warm):
    """Two bodies that touch the floor and one another, and a robot on legs, which is another island."""
    box, legs = BOX.format('friction=".6"'), (LEG.format(0.18, 0.1, 0), LEG.format(-0.18, -0.1, 1))
    found = apart(mujoco.MjModel.from_xml_string(FEW.format(iterations, searches, cone, warm, box, *legs)))
    assert found.worst <= ROUNDING, found


def check(text: str) -> None:
    model = mujoco.MjModel.from_xml_string(text)
    if missing(model) is None:
        found = apart(model)
        note(str(found))
        assert found.worst <= ROUNDING, text


@settings(quiet, max_examples=3)
@given(MODELS)
def test_drawn_models_roll_out_as_in_mujoco(text):
    check(text)


@pytest.mark.slow
@pytest.mark.timeout(900)
@settings(quiet, max_examples=100)
@given(MODELS)
def test_many_drawn_models_roll_out_as_in_mujoco(text):
    check(text)


TWO = '<body><joint axis="0 1 0" {0}/><joint axis="0 1 0"/><geom size=".05" pos=".2 0 0" mass="{1}"/></body>'


@pytest.mark.parametrize("mass", [1e-3, 1.0, 1e3])
def test_singular_mass_matrices_are_refused(mass):
    assert "singular" in missing(scene(TWO.format("", mass)))
    assert missing(scene(TWO.format(f'armature="{1e-3 * mass}"', mass))) is None
