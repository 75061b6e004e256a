# SPDX-License-Identifier: Apache-2.0
"""Small scenes and robots without a mistake, for tests that plant one."""

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" range="-1.5 1.5" damping="1"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -.4" size=".05" mass="1" contype="1" conaffinity="1"/>
      <body name="fore" pos="0 0 -.5">
        <joint name="elbow" axis="0 1 0" range="-2 2" damping="1"/>
        <geom name="fore" type="capsule" fromto="0 0 0 .4 0 0" size=".04" mass=".5" contype="1" conaffinity="1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="100" ctrlrange="-1.5 1.5" forcerange="-40 40"/>
    <position name="elbow" joint="elbow" kp="50" ctrlrange="-2 2" forcerange="-20 20"/>
  </actuator>
</mujoco>
"""
LEGS = """
<mujoco>
  <worldbody>
    <body name="torso" pos="0 0 .5">
      <freejoint/>
      <geom type="box" size=".1 .1 .05" mass="3"/>
      <body name="left" pos="0 .15 0"><joint name="left" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.46" size=".04" mass=".5"/></body>
      <body name="right" pos="0 -.15 0"><joint name="right" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.46" size=".04" mass=".5"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="left" ctrlrange="-2 2"/><motor joint="right" ctrlrange="-2 2"/></actuator>
</mujoco>
"""
HAND = """
<mujoco>
  <worldbody>
    <body name="lead" mocap="true" pos="0 0 1"/>
    <body name="hand" pos="0 0 1"><freejoint/><geom type="box" size=".05 .05 .05" mass="1"/></body>
    <body name="slider" pos="3 0 1"><joint name="slide" type="slide" axis="1 0 0"/>
      <geom type="box" size=".05 .05 .05" mass="1" contype="0" conaffinity="0"/></body>
  </worldbody>
  <equality><weld body1="lead" body2="hand"/></equality>
  <actuator><motor joint="slide" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
SCENE = """
timing = { control_dt = 0.02, timeout = 2.0 }

[[robot]]
name = "arm"
asset = "arm.xml"

[[object]]
name = "box"
shape = "box"
size = [0.1, 0.1, 0.1]
mass = 0.5
position = [0.6, 0.0, 0.05]

[[obstacle]]
name = "post"
shape = "box"
size = [0.1, 0.1, 0.6]
position = [1.0, 0.5, 0.3]

[goal]
object = "box"
position = [0.9, 0.0]

[[cost]]
term = "distance"
between = ["box", "goal"]

[[cost]]
term = "distance"
name = "near"
between = ["arm/fore", "box"]

[planner]
samples = 16
horizon = 20
dt = 0.02
refine = false

[planner.noise]
sigma = { range = 0.2 }
"""
TWO_ARMS = """
timing = { control_dt = 0.02, timeout = 2.0 }

[[robot]]
name = "left"
asset = "arm.xml"
position = [-1.5, 0.0, 1.0]

[[robot]]
name = "right"
asset = "arm.xml"
position = [1.5, 0.0, 1.0]

[[target]]
name = "lamp"
position = [pos_left, 0.3, 0.7]

[[target]]
name = "bell"
position = [pos_right, 0.3, 0.7]

[[cost]]
term = "distance"
name = "left"
between = ["left/fore", "lamp"]

[[cost]]
term = "distance"
name = "right"
between = ["right/fore", "bell"]

[planner]
samples = 16
horizon = 20
dt = 0.02
refine = false

[planner.noise]
sigma = { range = 0.2 }
"""
"""Two arms 3 m from each other, each with its own place."""
