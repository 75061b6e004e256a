# SPDX-License-Identifier: Apache-2.0
"""Models whose sensors look at forces, accelerations, contacts, limits and rays, and states for them."""

import mujoco
import numpy as np

BUSY = """
<mujoco>
  <option timestep="0.002" integrator="INTEGRATOR" magnetic=".3 -.2 .5"/>
  <worldbody>
    <geom name="floor" type="plane" size="4 4 .1"/>
    <camera name="high" pos="0 -2 2" euler="50 0 0" resolution="64 48"/>
    <site name="mount" pos=".2 0 .1"/><site name="held" pos="-.88 0 1.14"/><site name="hook" pos="1.3 .5 .3"/>
    <body name="mast" pos="0 0 .9" euler="10 20 0">
      <joint name="swing" axis="0 1 .2" damping=".3" stiffness="3" range="-4 4" limited="true" margin=".02"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .3 0 .05" mass=".6"/>
      <site name="root" pos=".02 .01 0" euler="20 30 0"/>
      <body name="arm" pos=".3 0 .05" euler="0 0 30">
        <joint name="ball" type="ball" damping=".1" range="0 12" limited="true"/>
        <geom type="box" size=".05 .03 .08" pos="0 0 -.1" mass=".4" euler="10 0 20"/>
        <site name="imu" pos=".03 .02 -.1" euler="30 10 60"/>
        <body name="hand" pos="0 0 -.2">
          <joint name="lift" type="slide" axis="0 0 1" range="-.05 .05" limited="true" margin=".08" damping="1"
            stiffness="20"/>
          <geom name="palm" type="sphere" size=".04" mass=".2"/>
          <site name="grip" pos="0 .01 0" euler="0 40 0"/>
        </body>
      </body>
    </body>
    <body name="cart" pos="1 .5 .08" quat=".9 .1 .1 .2">
      <freejoint/>
      <geom name="crate" type="box" size=".12 .1 .07" mass="2" friction="1 .02 .001" condim="6"/>
      <site name="zone" type="box" size=".2 .2 .3"/>
      <site name="sole" type="sphere" size=".1" pos=".1 .08 -.06"/>
      <site name="under" type="cylinder" size=".2 .01" pos="0 0 -.08"/>
      <body name="dome" pos="0 0 .1">
        <geom name="cap" type="sphere" size=".05" mass=".3"/>
        <site name="joint" pos="0 0 -.02" euler="0 0 45"/>
      </body>
    </body>
    <body name="stone" pos="1.02 .5 .3">
      <freejoint/>
      <site name="top" pos="0 0 .05"/>
      <geom name="rock" type="sphere" size=".08" mass=".7" condim="4" friction=".7 .03 .001"/>
    </body>
    <body name="trailer" pos="-1 0 1"><freejoint/>
      <geom type="box" size=".1 .1 .1" mass="1" contype="0" conaffinity="0"/>
      <body pos="0 0 .1"><geom type="box" size=".1 .02 .1" mass="1" contype="0" conaffinity="0"/>
      <site name="tow" pos=".1 0 .05" euler="0 20 0"/></body></body>
    <body name="hooked" pos="-1.3 0 1"><freejoint/>
      <geom type="box" size=".1 .05 .1" mass=".5" contype="0" conaffinity="0"/></body>
  </worldbody>
  <equality>
    <weld body1="trailer" body2="hooked"/>
    <connect site1="tow" site2="held"/>
  </equality>
  <tendon>
    <fixed name="mix" range="-.1 .15" limited="true" stiffness="4" springlength="-.02 .03">
      <joint joint="swing" coef=".5"/><joint joint="lift" coef="-1"/></fixed>
    <spatial name="cord" range="0 .31" limited="true" stiffness="5"><site site="hook"/><site site="top"/></spatial>
  </tendon>
  <actuator>
    <motor name="turn" joint="swing" gear="2" forcerange="-.5 .5" forcelimited="true"/>
    <position name="hold" joint="lift" kp="20"/>
    <motor name="pull" tendon="cord" gear="3"/><position name="mixed" tendon="mix" kp="5"/>
    <motor name="twist" joint="ball" gear=".1 .2 .3"/><motor name="jet" site="grip" gear="0 1 0 0 0 .1"/>
    <motor joint="swing" gear=".5"/>
  </actuator>
  <sensor>
    <accelerometer site="imu"/><accelerometer site="tow"/>
    <framelinacc objtype="body" objname="arm"/><framelinacc objtype="geom" objname="palm"/>
    <frameangacc objtype="site" objname="grip"/><frameangacc objtype="xbody" objname="cart"/>
    <force site="root"/><torque site="root"/><force site="grip"/><torque site="grip"/>
    <force site="joint"/><torque site="joint"/><force site="tow"/><torque site="tow"/>
    <touch site="zone"/><touch site="sole"/><touch site="under" cutoff="20"/>
    <magnetometer site="imu"/><camprojection site="grip" camera="high"/><subtreeangmom body="mast"/>
    <subtreeangmom body="cart"/><insidesite site="zone" objtype="body" objname="stone"/>
    <insidesite site="under" objtype="geom" objname="cap"/><insidesite site="zone" objtype="xbody" objname="dome"/>
    <tendonpos tendon="mix"/><tendonpos tendon="cord"/><tendonvel tendon="mix"/><tendonvel tendon="cord"/>
    <actuatorpos actuator="turn"/><actuatorpos actuator="twist"/><actuatorpos actuator="mixed"/>
    <actuatorvel actuator="pull"/><actuatorvel actuator="jet"/><actuatorvel actuator="twist"/>
    <actuatorfrc actuator="turn"/><actuatorfrc actuator="hold"/><actuatorfrc actuator="mixed"/>
    <jointactuatorfrc joint="swing"/><jointactuatorfrc joint="lift"/>
    <tendonactuatorfrc tendon="cord"/><tendonactuatorfrc tendon="mix"/>
    <jointlimitpos joint="swing"/><jointlimitvel joint="swing"/><jointlimitfrc joint="swing"/>
    <jointlimitpos joint="lift"/><jointlimitvel joint="lift"/><jointlimitfrc joint="lift"/>
    <jointlimitpos joint="ball"/><jointlimitvel joint="ball"/><jointlimitfrc joint="ball"/>
    <tendonlimitpos tendon="mix"/><tendonlimitvel tendon="mix"/><tendonlimitfrc tendon="mix"/>
    <tendonlimitpos tendon="cord"/><tendonlimitfrc tendon="cord"/>
    <e_potential/><e_kinetic/><rangefinder site="grip" data="dist normal"/>
    <contact name="net" subtree1="cart" geom2="floor" num="1" reduce="netforce"
      data="found force torque dist pos normal tangent"/>
    <contact name="other" geom1="floor" body2="cart" num="1" reduce="netforce" data="force"/>
    <contact name="deep" geom1="floor" body2="cart" num="2" reduce="mindist"
      data="found force dist pos normal tangent"/>
    <contact name="strong" body1="cart" num="1" reduce="maxforce" data="found force torque pos"/>
    <contact name="count" subtree1="cart" num="1" data="found"/>
    <contact name="within" site="zone" body2="stone" num="1" reduce="mindist" data="found normal"/>
  </sensor>
</mujoco>
"""
"""Sensors of every kind that is read within a step, and those of positions and velocities that came with them."""

RAYS = """
<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  .5 0 0  0 .4 0  0 0 .6  .4 .4 .1"/>
    <material name="glass" rgba="1 1 1 0"/>
    <hfield name="hills" nrow="4" ncol="6" size=".7 .5 .4 .2"
      elevation="0 .3 1 .2 .4 .8  .5 .9 .1 .6 1 .3  .2 0 .7 .8 .1 .5  1 .4 .3 .9 .6 0"/>
  </asset>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="plane" type="plane" size="2 3 .1" pos="0 0 -1"/>
    <geom type="box" size=".3 .2 .4" pos="1 0 0" euler="10 20 30"/>
    <geom type="ellipsoid" size=".3 .2 .5" pos="-1 0 .1" euler="40 20 30"/>
    <geom type="mesh" mesh="wedge" pos="0 1.2 0" euler="0 30 10"/>
    <geom type="hfield" hfield="hills" pos="-.3 1 -.8" euler="25 -20 30"/>
    <geom type="sphere" size=".9" material="glass"/>
    <geom type="sphere" size=".8" rgba="0 0 0 0"/>
    <body pos="0 -1.2 0">
      <joint type="slide" axis="0 0 1"/><geom type="capsule" size=".2 .4" euler="20 10 0" mass="1"/>
      <geom type="sphere" size=".25" pos="0 0 .9" mass="1"/>
    </body>
    <body pos="0 0 1"><joint axis="1 0 0"/><geom type="cylinder" size=".4 .1" mass="1" euler="10 50 0"/></body>
    <body>
      <joint type="ball"/>
      <geom type="sphere" size=".05" mass=".1" name="ball"/>
      <site name="beam"/>
      <site name="a" euler="90 0 0" pos=".2 0 0"/><site name="b" euler="90 90 0"/><site name="c" euler="90 180 0"/>
      <site name="d" euler="90 270 0"/><site name="e" euler="180 0 0"/><site name="f" euler="120 45 0"/>
    </body>
  </worldbody>
  <sensor>
    <rangefinder site="beam"/><rangefinder site="a" cutoff=".9"/><rangefinder site="b"/><rangefinder site="c"/>
    <rangefinder site="d"/><rangefinder site="e"/><rangefinder site="f" data="dist dir origin point normal depth"/>
    <rangefinder site="a" data="normal"/><rangefinder site="b" data="normal"/><rangefinder site="c" data="normal"/>
    <rangefinder site="d" data="normal"/><rangefinder site="e" data="normal"/>
  </sensor>
</mujoco>
"""
"""Rays from a body that turns among geoms of all kinds, two of which nobody sees."""


def drawn(model: mujoco.MjModel, seed: int, worlds: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States ``[W, nstate]`` near the model's own, larger turns in later worlds, and controls ``[W, T, nu]``."""
    rng = np.random.default_rng(seed)
    rows = []
    for world in range(worlds):
        q = model.qpos0.copy()
        step = rng.normal(size=model.nv) * (0.3 if model.nsite < 8 else 0.04 + 0.1 * world / worlds)
        mujoco.mj_integratePos(model, q, step if model.nsite > 7 else 9.0 * step, 1.0)
        rows.append([0.0, *q, *(0.3 * rng.normal(size=model.nv)), *np.zeros(model.na)])
    return np.array(rows), rng.uniform(-1, 1, (worlds, steps, model.nu))
