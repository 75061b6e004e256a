# SPDX-License-Identifier: Apache-2.0
"""What URDF and USD files say beyond what is simulated: named, one line each; what can be held holds."""

from xml.etree import ElementTree

import numpy as np
import pytest
from small_scenes import make_scene

from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.importers import urdf_losses

ROBOT = """
<robot name='r'>
  <link name='base'/>
  <link name='arm'>
    <inertial><mass value='1'/><inertia ixx='.1' iyy='.1' izz='.1' ixy='0' ixz='0' iyz='0'/></inertial>
  </link>
  <joint name='j' type='revolute'><parent link='base'/><child link='arm'/><axis xyz='0 0 1'/>
    <limit lower='-1' upper='1' effort='5' velocity='2'/>{inside}</joint>
  {more}
</robot>
"""
INSIDE = "<dynamics damping='.5' friction='.3' spring_stiffness='3'/><safety_controller k_velocity='1'/>"
MORE = """
  <transmission name='gears'><joint name='j'/></transmission> <loop_joint name='rod'/>
  <gazebo reference='arm'><mu1>.2</mu1><sensor name='imu'/></gazebo> <mujoco><compiler/></mujoco>
"""
LINES = (
    "<transmission> of gears: reductions and motors: joints have the effort and velocity of their",
    "<gazebo> with mu1, sensor of arm: Gazebo's friction, springs, sensors and plugins",
    "<mujoco>: options of MuJoCo: give them in [engine]",
    "<loop_joint> of rod: a closed loop",
    '<dynamics spring_stiffness="..."> of j',
    "<safety_controller> of j: soft limits",
)


def built(file, text):
    """The robot of a file, compiled."""
    file.write_text(text)
    robot = {"name": "r", "asset": str(file), "drive": {"mode": "effort", "limit": 1.0}}
    return compile_scene(
        make_scene(robot=[robot], ground=False, goal={"frame": "r/arm", "position": (0.0, 0.0)}), cache=False
    )


def test_what_a_urdf_says_beyond_links_and_joints_is_named(tmp_path):
    compiled = built(tmp_path / "r.urdf", ROBOT.format(inside=INSIDE, more=MORE))
    for line in LINES:
        assert any(note.startswith(f"r: not taken over: {line}") for note in compiled.notes), (line, compiled.notes)
    assert len(compiled.notes) == len(LINES)
    assert not compiled.repaired
    model = compiled.spec().compile()
    assert (model.dof_damping[0], model.dof_frictionloss[0]) == pytest.approx((0.5, 0.3))


def test_of_a_plain_urdf_nothing_is_lost(tmp_path):
    assert built(tmp_path / "r.urdf", ROBOT.format(inside="", more="")).notes == ()


def test_macros_that_nobody_expanded_are_named():
    text = "<robot xmlns:xacro='http://www.ros.org/wiki/xacro'><link name='a'/><xacro:arm/></robot>"
    assert urdf_losses(ElementTree.fromstring(text)) == ["<xacro:arm>: an unexpanded macro: run xacro first"]


STAGE = """#usda 1.0
( defaultPrim = "rob"
  metersPerUnit = 1
  kilogramsPerUnit = 1
  upAxis = "Z" )
def PhysicsScene "scene" {
  float physics:gravityMagnitude = 1.62
  int mjc:option:iterations = 7
}
def Xform "rob" ( prepend apiSchemas = ["PhysicsArticulationRootAPI"] ) {
  def Xform "base" ( prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"] ) {
    float physics:mass = 1
  }
  def Xform "arm" ( prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysxRigidBodyAPI"] ) {
    float physics:mass = 2
    float3 physics:diagonalInertia = (0.2, 0.3, 0.4)
    float physxRigidBody:linearDamping = 0.5
    def IsaacContactSensor "touch" {
      float radius = 0.1
    }
  }
  def PhysicsFixedJoint "fix" {
    rel physics:body1 = </rob/base>
  }
  def PhysicsRevoluteJoint "j" ( prepend apiSchemas = ["PhysicsDriveAPI:angular", "PhysxJointAPI"] ) {
    uniform token physics:axis = "Z"
    rel physics:body0 = </rob/base>
    rel physics:body1 = </rob/arm>
    float physics:lowerLimit = -20
    float physics:upperLimit = 30
    float drive:angular:physics:stiffness = 10
    float drive:angular:physics:maxForce = 7
    float physxJoint:jointFriction = 0.3
    float physxJoint:armature = 0.07
    float physxJoint:maxJointVelocity = 90
    float mjc:damping = 0.6
    float mjc:stiffness = 4
  }
}
"""


def test_what_a_usd_stage_says_is_held_or_named(tmp_path):
    compiled = built(tmp_path / "r.usda", STAGE)
    lines = {
        "physics:gravityMagnitude of 1.62 m/s²: engine.gravity sets it",
        "mjc:option:iterations of scene: options of MuJoCo: give them in [engine]",
        "physxRigidBody:linearDamping of arm: drag of bodies",
        "IsaacContactSensor of touch: sensors",
        "drive:angular:physics:stiffness of j: gains and targets of its drives: the scene has others",
        "physxJoint:jointFriction of j: friction of joints: PhysX has it as a share of their load",
    }
    assert set(compiled.notes) == {f"r: not taken over: {line}" for line in lines}
    model, layout = compiled.spec().compile(), compiled.layout
    found = (model.dof_armature[0], model.dof_damping[0], model.jnt_stiffness[0], layout.actuator_effort[0])
    assert found == pytest.approx((0.07, 0.6, 4.0, 7.0))
    np.testing.assert_allclose(layout.dof_speed[0], np.radians(90.0), rtol=1e-6)
