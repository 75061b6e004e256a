# SPDX-License-Identifier: Apache-2.0
"""Settings of an MJCF file in a scene: those that hold, and limits of actuators that drives replace."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from native_robots import compiled_native

from warpmpc.scene.model.mujoco_model import make_world

ARM = """
<mujoco><compiler angle="radian" {compiler}>{inside}</compiler><option {option}/><worldbody>
  <body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" range="-2 2"/>
    <geom type="capsule" size=".03" fromto="0 0 0 .4 0 0" mass="2"/>
    <body name="fore" pos=".4 0 0"><joint name="slide" type="slide" axis="1 0 0" range="0 .2"/>
      <joint name="elbow" axis="0 1 0" range="-2 2"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="1" group="2"/><geom size=".02" mass="5"/>
    </body>
  </body>
</worldbody>
<tendon><fixed name="both"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="1"/></fixed></tendon>
<actuator>{actuators}</actuator></mujoco>
"""
MOTORS = """
  <motor name="a" joint="shoulder" gear="150" ctrlrange="-1 1"/>
  <general name="b" joint="elbow" gear="2" gainprm="20" biastype="affine" biasprm="0 -20 0" forcerange="-7 14"/>
  <motor name="c" joint="slide" ctrlrange="-9 5" gear="-2" forcerange="-6 6"/>
"""
MUSCLE = '<muscle name="m" tendon="both" ctrlrange="0 1"/>'


def arm(folder, *, actuators: str = MOTORS, compiler: str = "", inside: str = "", option: str = "") -> Path:
    path = folder / "arm.xml"
    path.write_text(ARM.format(actuators=actuators, compiler=compiler, inside=inside, option=option))
    return path


@pytest.mark.parametrize(
    ("compiler", "inside"),
    [
        ('settotalmass="11"', ""),
        ('settotalmass="11" boundmass="3" inertiafromgeom="true"', ""),
        ('inertiagrouprange="0 1"', ""),
        ("", '<lengthrange maxforce="50" accel="5"/>'),
    ],
    ids=["total mass", "total mass with bounds", "groups", "lengthrange"],
)
def test_what_the_compiler_is_told_holds(tmp_path, compiler, inside):
    path = arm(tmp_path, actuators=MUSCLE, compiler=compiler, inside=inside)
    own = mujoco.MjModel.from_xml_path(str(path))
    compiled = compiled_native(path)
    model = make_world(compiled, timestep=0.002).model
    for name in ("body_mass", "body_inertia", "body_ipos", "actuator_lengthrange", "actuator_acc0"):
        np.testing.assert_allclose(getattr(model, name), getattr(own, name), rtol=1e-6, err_msg=name)
    assert not any("is not what the file says" in note for note in compiled.notes)


VELOCITY = {"mode": "velocity", "damping": 5.0, "limit": 1.0}


def test_drives_give_joints_no_more_force_than_the_motors_that_they_replace(tmp_path):
    compiled = compiled_native(arm(tmp_path), drive=VELOCITY)
    assert compiled.layout.actuator_effort.tolist() == [150.0, 12.0, 28.0]
    model = make_world(compiled, timestep=0.002).model
    np.testing.assert_allclose(model.jnt_actfrcrange, [[-150.0, 150.0], [-12.0, 12.0], [-28.0, 28.0]])
    (note,) = [note for note in compiled.notes if "replaced" in note]
    for part in ("150 N·m shoulder", "28 N·m elbow", "12 N slide", "drives without effort_limit have as much"):
        assert part in note
    told = compiled_native(arm(tmp_path), drive={**VELOCITY, "effort_limit": 3.0})
    assert told.layout.actuator_effort.tolist() == [3.0, 3.0, 3.0]


def test_the_efforts_that_a_drive_may_ask_for_are_those_of_the_motors(tmp_path):
    layout = compiled_native(arm(tmp_path), drive={"mode": "effort"}).layout
    assert layout.control_upper.tolist() == [150.0, 12.0, 28.0]


def test_actuators_without_a_limit_are_told(tmp_path):
    servo = '<position name="p" joint="elbow" kp="5" ctrlrange="-1 1"/>' + MUSCLE
    compiled = compiled_native(arm(tmp_path, actuators=servo), drive=VELOCITY)
    assert compiled.layout.actuator_effort.min() >= 1e6
    notes = " ".join(compiled.notes)
    assert "the file tells no limit of the actuators on elbow: give the drive an effort_limit" in notes
    assert "its actuators m act on no joint" in notes
