# SPDX-License-Identifier: Apache-2.0
"""Models for the engine `fused` with friction, equalities, tendons, activations and sites: small trees in one model."""

EQUALITIES = """
<mujoco><compiler angle="radian" autolimits="true"/>{option}
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <body name="four_1" pos="0 0 1"><joint name="four_1" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03" mass="0.5"/>
    <body name="four_2" pos="0 0 0.3"><joint name="four_2" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="0.6"/>
      <body name="four_3" pos="0.4 0 0"><joint name="four_3" axis="0 1 0" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.5"/></body>
    </body>
  </body>
  <body name="rope_1" pos="2 0 1.5"><joint name="rope_1" type="ball" damping="0.02"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.04" mass="0.5"/>
    <site name="rope_end" pos="0.3 0.02 0" euler="0.3 0.2 0.1"/>
    <body name="rope_2" pos="0.3 0 0"><joint name="rope_2" type="ball" damping="0.02"/>
      <geom type="box" pos="0.1 0 0" size="0.1 0.04 0.06" mass="0.4"/></body>
  </body>
  <body name="free_1" pos="2.7 0.1 1.4"><freejoint/><geom type="box" size=".1 .15 .12" mass="1"/>
    <site name="corner" pos="-.1 .05 .1" euler="-0.3 0.5 0.1"/></body>
  <body name="held" pos="-2 0 1" quat="0.9 0.1 0.2 0.1"><freejoint/><geom type="box" size=".1 .15 .08"
    mass="1.2"/></body>
  <body name="pair_1" pos="-4 0 1" quat="0.9 0.3 0.2 0.1"><freejoint/><geom type="box" size=".1 .15 .08" mass="1.2"/>
    <site name="plug" pos=".1 0 .02" euler="0.4 0.1 -0.2"/></body>
  <body name="pair_2" pos="-3.7 0 1"><joint type="slide" name="rail" axis="0 1 0.2" frictionloss="0.5"/>
    <joint name="swing" axis="0 0 1"/> <geom type="box" size=".12 .1 .05" mass="0.8"/>
    <site name="socket" pos="-.1 .05 0" euler="0.1 -0.2 0.1"/></body>
  <body name="gear_1" pos="0 3 1"><joint name="gear_1" axis="0 0 1" frictionloss="0.08" solreffriction="0.03 0.8"/>
    <geom type="cylinder" size=".1 .05" mass="2" pos="0.05 0 0"/>
    <body name="gear_3" pos="0 0 .2"><joint name="gear_3" axis="1 0 0" ref="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0.3 0" size="0.03" mass="0.2"/></body></body>
  <body name="gear_2" pos="1 3 1"><joint name="gear_2" axis="0 1 0" ref="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.05" mass="0.7"/></body>
  <body name="still" pos="-1 3 1"><joint name="still" axis="0 1 0" armature="0.02"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.05" mass="0.7"/></body>
  <body name="cone_1" pos="3 3 1.5"><joint name="cone_1" type="ball" range="0 0.5" damping="0.05" stiffness="2"/>
    <geom type="capsule" fromto="0 0 0 0.1 0 -0.3" size="0.04" mass="0.5"/>
    <body name="cone_2" pos="0.1 0 -0.3"><joint name="cone_2" type="ball" range="0 0.2" margin="0.05" springdamper="0 0"
        frictionloss="0.02" solreflimit="0.03 0.7"/><geom type="capsule" fromto="0 0 0 0.2 0 -0.2" size="0.04"
          mass="0.3"/></body></body>
  <body name="cage" pos="4.5 3 1.2" quat="0.9 0.2 0.1 0.3"><joint name="cage" type="free" stiffness="30"
    damping="0.4" frictionloss="0.1"/>
    <geom type="box" size=".1 .15 .08" mass="1.2"/></body>
</worldbody>
<equality>
  <connect body1="four_3" anchor="0 0 -0.3"/>
  <connect site1="rope_end" site2="corner" active="false"/>
  <connect body1="rope_2" body2="free_1" anchor="0.2 0 0.03" solref="0.03 1" solimp="0.5 0.9 0.4 0.5 2"/>
  <weld body1="held" relpose="0.02 0.03 0.05 0.9 0.15 0.2 0.05" torquescale="0.4" solref="0.04 0.9"
    solimp="0.3 0.9 0.5 0.4 2" anchor="0.1 0 0.05"/>
  <weld site1="plug" site2="socket" solref="0.05 0.8"/>
  <joint joint1="gear_2" joint2="gear_1" polycoef="0.05 0.7 0.2 -0.1 0.05" solimp="0.7 0.95 0.1 0.5 2"/>
  <joint joint1="gear_3" joint2="gear_1" polycoef="0 -1.3 0 0 0" solref="-600 -30"/>
  <joint joint1="still" polycoef="0.2 0 0 0 0"/>
</equality>
<actuator>
  <motor joint="gear_1" gear="0.3"/> <motor joint="four_1" gear="0.5"/> <motor joint="swing" gear="0.2"/>
  <motor joint="cone_1" gear="0.2 0.1 0.3"/> <velocity joint="cone_2" kv="0.1" gear="0.5 0.3 -0.2"/>
  <velocity joint="cage" kv="0.5" gear="1 0 0.4 0.3 0 0"/>
</actuator>
</mujoco>
"""
"""Equalities of every kind within trees, between them and to the world; friction and limits of joints of every type."""

TENDONS = """
<mujoco><compiler angle="radian" autolimits="true"/>{option}
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <body name="finger_1" pos="0 0 1"><joint name="finger_1" axis="0 1 0" armature="0.01" damping="0.02"/>
    <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03" mass="0.3"/>
    <body name="finger_2" pos="0.2 0 0"><joint name="finger_2" axis="0 1 0" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03" mass="0.2"/>
      <body name="finger_3" pos="0.2 0 0"><joint name="finger_3" axis="0 1 0" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.03" mass="0.1"/></body>
    </body>
    <body name="side" pos="0.1 0.1 0"><joint name="side" axis="0 0 1" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0.2 0" size="0.03" mass="0.1"/></body>
  </body>
  <body name="cart" pos="2 0 1"><joint name="cart" type="slide" axis="1 0 0" ref="0.1"/>
    <geom type="box" size=".1 .15 .08" mass="1.2"/>
    <body name="pole" pos="0 0 0.1"><joint name="pole" axis="0 1 0" stiffness="1"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.03" mass="0.3"/></body></body>
  <site name="hook" pos="-2 0.3 2"/> <site name="ring" pos="-2.6 0 2"/>
  <body name="bob" pos="-2 0 1" quat="0.9 0.1 0.2 0.1"><freejoint/><geom type="box" size=".1 .15 .08" mass="1.2"/>
    <site name="top" pos="0.05 0 .08"/> <site name="edge" pos="-.1 .1 .02"/></body>
  <body name="arm_1" pos="-3 0 1"><joint name="arm_1" axis="0 1 0.2" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.04" mass="0.6"/> <site name="elbow" pos="0.06 0.02 0.3"/>
    <body name="arm_2" pos="0 0 0.4"><joint name="arm_2" type="ball" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0.1" size="0.04" mass="0.4"/> <site name="wrist"
        pos="0.2 0.05 0.12"/></body>
  </body>
  <body name="drone" pos="4 0 1" quat="0.9 0.1 0.3 0.2"><joint type="free" damping="0.1"/>
    <geom type="box" size=".2 .15 .05" mass="0.8"/>
    <site name="rotor_1" pos=".2 .1 .05" euler="0.1 0.2 0.3"/> <site name="rotor_2" pos="-.2 -.1 .05"
      euler="-0.2 0.1 0.3"/>
    <body name="boom" pos="0 0 -0.1"><joint name="boom" axis="1 0 0" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.2"/>
      <site name="nozzle" pos="0 0 -0.3" euler="1.2 0.2 0"/></body></body>
  <body name="wheel" pos="0 3 1"><joint name="wheel" axis="0 0 1" damping="0.01"/>
    <geom type="cylinder" size=".1 .05" mass="2" pos="0.05 0 0"/></body>
  <body name="lift" pos="1 3 1"><joint name="lift" type="slide" axis="0 0 1" damping="2"/>
    <geom type="box" size=".1 .1 .05" mass="1"/></body>
  <body name="flap" pos="2 3 1"><joint name="flap" axis="0 1 0" armature="0.02" actuatorfrcrange="-0.5 0.4"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.05" mass="0.3"/></body>
  <body name="kite" pos="4 3 1"><joint type="free" damping="0.2"/><geom type="box" size=".2 .15 .05" mass="0.5"/></body>
</worldbody>
<tendon>
  <fixed name="curl" damping="0.05" stiffness="3" springlength="-0.1 0.15" frictionloss="0.02" armature="0.02">
    <joint joint="finger_1" coef="0.3"/> <joint joint="finger_2" coef="0.6"/> <joint joint="finger_3"
      coef="0.8"/></fixed>
  <fixed name="cross" damping="0.08" stiffness="2" range="-0.1 0.1" margin="0.01" solreflimit="0.03 0.9">
    <joint joint="finger_3" coef="0.5"/> <joint joint="side" coef="-0.7"/></fixed>
  <fixed name="link" damping="0.4" stiffness="5" range="-0.05 0.2" frictionloss="0.3" solreffriction="0.04 1">
    <joint joint="cart" coef="1.2"/> <joint joint="pole" coef="-0.3"/> <joint joint="finger_1" coef="0.2"/></fixed>
  <fixed name="half"><joint joint="finger_2" coef="1"/></fixed>
  <spatial name="sling" stiffness="60" damping="1.5" springlength="0.7" range="0 1.05">
    <site site="hook"/> <site site="top"/></spatial>
  <spatial name="bridle" damping="0.3" frictionloss="0.4">
    <site site="ring"/> <site site="edge"/> <pulley divisor="2"/> <site site="edge"/> <site site="elbow"/>
    <site site="wrist"/></spatial>
</tendon>
<equality>
  <tendon tendon1="curl" tendon2="half" polycoef="0.01 0.9 0.1 0 0" solref="0.05 1"/>
</equality>
<actuator>
  <position tendon="cross" kp="6" kv="0.3" gear="0.8"/> <motor tendon="curl" gear="0.5"/>
  <velocity tendon="link" kv="3" forcerange="-2 2"/> <general tendon="bridle" gainprm="4" biastype="affine"
    biasprm="0 -2 -0.5"/>
  <motor site="rotor_1" gear="0 0 6 0 0 0.2"/> <general site="rotor_2" gear="0 0.3 5 0 0.1 -0.2" biastype="affine"
    biasprm="0.5 0 -0.3"/>
  <motor site="nozzle" gear="1 0 2 0.1 0 0"/>
  <intvelocity joint="wheel" kp="4" actrange="-0.1 0.15"/>
  <general joint="lift" dyntype="filter" dynprm="0.05" gainprm="20" biastype="affine" biasprm="10 0 -1"/>
  <general joint="lift" dyntype="filterexact" dynprm="0.03" gainprm="10" actlimited="true" actrange="-0.4 0.3"
    actearly="true"/>
  <general joint="flap" dyntype="integrator" gainprm="3" ctrlrange="-1 1" actlimited="true" actrange="-1 1"
    actearly="true"
    gaintype="affine" biastype="affine" biasprm="0.1 -1 -0.2"/>
  <general joint="flap" dyntype="filter" dynprm="0.02" gaintype="affine" gainprm="1 0.3 -0.2" forcerange="-0.4 0.4"/>
</actuator>
</mujoco>
"""
"""Tendons along joints and sites with everything they have, what drives them, thrusters and activations."""

PAIRS = """
<mujoco><compiler angle="radian" autolimits="true"/>{option}
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <geom name="floor" type="plane" size="9 9 .1" contype="1"/>
  <body name="box" pos="0 0 0.2" quat="0.9 0.1 0.2 0.1"><freejoint/><geom name="box" type="box" size=".1 .15 .12"
    mass="1"/>
  </body>
  <body name="ball" pos="0.1 0 0.45"><freejoint/><geom name="ball" type="sphere" size=".12" mass="0.6"/></body>
  <body name="pill" pos="1 0 0.12" quat="0.7 0.7 0.1 0"><freejoint/>
    <geom name="pill" type="capsule" size=".06 .15" mass="0.6" conaffinity="1" priority="1"
      solimp="0.7 0.95 0.02 0.3 3"/></body>
  <body name="upper" pos="-1 0 0.5"><joint name="upper" axis="0 1 0" damping="0.1" range="-0.5 0.6"
    solimplimit="0.8 0.97 0.05 0.4 1"/>
    <geom name="upper" type="capsule" fromto="0 0 0 0.3 0 0" size=".05" mass="0.6"/>
    <body name="lower" pos="0.3 0 0"><joint name="lower" axis="0 1 0" range="-1 1"/>
      <geom name="lower" type="capsule" fromto="0 0 0 0 0 -0.3" size=".05" mass="0.4" conaffinity="1"/></body></body>
  <body name="beam" pos="2 0 1"><joint name="beam" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.05" mass="0.7"/></body>
</worldbody>
<contact>
  <pair geom1="floor" geom2="box" condim="3" friction="0.4 0.4 0.005 0.0001 0.0001" solref="0.03 0.9" margin="0.01"/>
  <pair geom1="ball" geom2="box" condim="1" solimp="0.6 0.9 0.02 0.4 4"/>
  <pair geom1="ball" geom2="floor"/>
  <pair geom1="lower" geom2="floor" condim="3" friction="1.2 1.2 0.005 0.0001 0.0001" solimp="0.8 0.95 0.01 0.5 2"/>
  <exclude body1="upper" body2="lower"/>
</contact>
<equality><joint joint1="beam" polycoef="0.3 0 0 0 0" solimp="0.5 0.95 0.5 0.6 5"/></equality>
<actuator><motor joint="upper" gear="3"/> <motor joint="lower" gear="2"/></actuator>
</mujoco>
"""
"""Explicit pairs, of geoms that would touch anyway and of others; impedances of several powers."""

SWIMMERS = """
<mujoco><compiler angle="radian" autolimits="true"/>
<option timestep="0.004" integrator="Euler" iterations="50" tolerance="1e-8" density="800" viscosity="0.3"
  wind="0.3 -0.2 0.1"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <body name="fish" pos="0 0 1" quat="0.9 0.1 0.2 0.1"><freejoint/>
    <geom type="ellipsoid" size=".2 .1 .08" mass="4" pos="0.03 0 0.02"/>
    <body name="tail" pos="-0.2 0 0"><joint name="tail" axis="0 0 1" armature="0.01"/>
      <geom type="box" size=".1 .02 .06" pos="-.1 0 0" mass="0.5"/>
      <body name="fin" pos="-0.2 0 0"><joint name="fin" type="ball" damping="0.02" armature="0.01"/>
        <geom type="box" size=".08 .01 .07" pos="-.08 0.01 0" euler="0.2 0.1 0.3" mass="0.2"/></body></body></body>
  <body name="raft" pos="2 0 1"><joint name="raft" type="slide" axis="1 0 0.2"/>
    <geom type="box" size=".2 .15 .05" mass="3"/>
    <body name="mill" pos="0 0 0.2"><joint name="mill" axis="0 1 0"/><geom type="box" size=".2 .03 .01"
      mass="0.4"/></body></body>
</worldbody>
<actuator><motor joint="tail" gear="0.5"/><motor joint="mill" gear="0.3"/></actuator>
</mujoco>
"""
"""Bodies in a dense and viscous medium that flows."""
