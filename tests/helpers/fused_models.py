# SPDX-License-Identifier: Apache-2.0
"""Models for the engine `fused`: many small trees in one, since compiling costs more than stepping, and random ones."""

from __future__ import annotations

import mujoco
import numpy as np

OPTION = """
<option timestep="0.004" integrator="{integrator}" iterations="50" tolerance="1e-8"><flag island="disable"/></option>"""

DYNAMICS = """
<mujoco><compiler angle="radian" autolimits="true"/>{option}
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <body name="lone" pos="0.1 0.2 1.5" quat="0.9 0.1 0.3 0.2"><freejoint/>
    <inertial pos="0.15 -0.1 0.2" mass="2" fullinertia="0.05 0.06 0.07 0.004 -0.003 0.002"/>
  </body>
  <body name="ball" pos="5 0 1"><joint type="free" damping="0.3" armature="0.02"/>
    <geom type="box" size=".1 .2 .05" mass="0.7"/>
    <body pos="0.1 0.2 0.3" quat="0.8 0.2 -0.3 0.1"><geom type="sphere" size=".1" mass="0.3"/></body>
  </body>
  <body name="trunk" pos="-4 3 1.5" quat="0.9 0.1 0.3 0.2"><freejoint/>
    <inertial pos="0.05 -0.1 0.02" mass="2" diaginertia="0.05 0.06 0.07"/>
    <body name="tail" pos="0.3 0 0.1" quat="0.8 0.2 -0.3 0.1">
      <joint name="tail" type="ball" pos="0.05 -0.02 0.03" damping="0.02" armature="0.004"/>
      <inertial pos="0.05 0.02 -0.07" mass="0.7" diaginertia="0.01 0.02 0.015"/>
    </body>
    <body name="leg" pos="-0.3 0.1 0" quat="0.7 -0.1 0.2 0.5">
      <joint name="leg_1" axis="0 0 1" damping="0.1"/> <joint name="leg_2" axis="0 1 0" pos="0.02 0 0.01"/>
      <joint name="leg_3" axis="1 0 0" armature="0.01"/>
      <inertial pos="0.1 0 0.03" mass="0.5" diaginertia="0.01 0.02 0.015"/>
      <body name="welded" pos="0.1 0 0" quat="0.7 0.7 0 0">
        <inertial pos="0 0.06 0.02" mass="0.3" diaginertia="0.01 0.01 0.01"/>
        <body name="foot" pos="0.1 0 0">
          <joint name="foot_x" type="slide" axis="1 0.2 0" range="-0.05 0.08" stiffness="40" damping="0.4"/>
          <joint name="foot_1" axis="0 0.6 0.8" range="-0.5 0.5" stiffness="3" springref="0.2"/>
          <inertial pos="0 0.06 0.02" mass="0.3" diaginertia="0.01 0.01 0.01"/>
        </body>
      </body>
    </body>
  </body>
  <body name="tower" pos="2 -3 0.4" quat="0.8 0 0.6 0">
    <geom type="box" size=".1 .1 .1"/>
    <body name="platform" pos="0.1 0.1 0.2" quat="0.9 0.2 0.1 0">
      <body name="arm_1" pos="0 0 0.3" gravcomp="1">
        <joint name="arm_1" axis="0 0 1" range="-0.6 0.6" solreflimit="0.02 0.9" damping="0.5" armature="0.05"/>
        <inertial pos="0.1 0 0.1" mass="1.5" diaginertia="0.02 0.03 0.02"/>
        <body name="arm_2" pos="0.2 0 0.3" gravcomp="0.5">
          <joint name="arm_2" axis="0 1 0.3" ref="0.3" range="-0.4 0.9" solreflimit="-800 -30"
            solimplimit="0.8 0.97 0.02 0.4 2"/>
          <inertial pos="0.1 0 0.1" mass="1" diaginertia="0.02 0.03 0.02"/>
          <body name="arm_3" pos="0.2 0 0.1">
            <joint name="arm_3" type="slide" axis="-1 0 0.5" ref="0.1" range="-0.1 0.3" margin="0.02"
              actuatorfrcrange="-6 5"/>
            <inertial pos="0.1 0 0.1" mass="0.6" diaginertia="0.01 0.01 0.02"/>
            <body name="finger_1" pos="0.1 0.05 0"><joint name="finger_1" axis="0 0 -1"/>
              <inertial pos="0.05 0 0" mass="0.1" diaginertia="0.001 0.001 0.001"/></body>
            <body name="finger_2" pos="0.1 -0.05 0"><joint name="finger_2" axis="-0.2 0.3 0.9"/>
              <inertial pos="0.05 0 0" mass="0.1" diaginertia="0.001 0.001 0.001"/></body>
          </body>
        </body>
      </body>
    </body>
  </body>
  <body name="base" pos="-2 -2 0.2">
    <joint name="base_x" type="slide" axis="1 0 0"/> <joint name="base_y" type="slide" axis="0 1 0"/>
    <joint name="base_yaw" axis="0 0 1"/>
    <geom type="cylinder" size=".2 .1" mass="5"/>
    <body name="mast" pos="0.1 0 0.2"><joint name="mast" axis="0 1 0" stiffness="20" damping="1"/>
      <geom type="capsule" size=".03 .2" mass="0.4"/></body>
  </body>
  <body name="pendulum" pos="3 3 2"><joint name="pendulum" type="ball" damping="0.05"/>
    <geom type="capsule" size=".03 .2" pos="0 0 -.2" mass="0.5"/>
    <body name="bob" pos="0 0 -0.4"><joint name="bob" type="ball" pos="0 0 0.02"/>
      <geom type="ellipsoid" size=".1 .05 .07" pos="0.03 0 -.1" mass="0.3"/></body>
  </body>
</worldbody>
<actuator>
  <motor joint="leg_1" gear="2" ctrllimited="true" ctrlrange="-0.5 0.5"/>
  <position joint="leg_2" kp="12" kv="0.4"/>
  <velocity joint="leg_3" kv="0.6" forcerange="-0.3 0.2"/>
  <position joint="arm_1" kp="60" kv="3" forcerange="-9 8" gear="1.5"/>
  <general joint="arm_2" gaintype="affine" gainprm="4 1.5 -0.3" biastype="affine" biasprm="0.2 -3 -0.5" gear="-0.7"/>
  <general joint="arm_3" gaintype="fixed" gainprm="30" biastype="affine" biasprm="0 -10 -2"/>
  <motor joint="arm_3" gear="5"/>
  <motor jointinparent="finger_1" gear="0.3"/>
  <velocity joint="base_x" kv="100" forcerange="-40 40"/>
  <velocity joint="base_y" kv="100" forcerange="-40 40"/>
  <velocity joint="base_yaw" kv="30"/>
</actuator>
</mujoco>
"""
"""Every kind of joint, chains and branches, offsets of every sort, springs, limits, and every actuator there is."""

CONTACTS = """
<mujoco><compiler angle="radian" autolimits="true"/>{option}
<default><geom contype="0" conaffinity="1"/></default>
<worldbody>
  <geom type="plane" size="9 9 .1" contype="1" conaffinity="1" friction="0.8"/>
  <body name="box" pos="0 0 0.25" quat="0.9 0.1 0.3 0.2"><freejoint/>
    <geom type="box" size=".1 .2 .15" mass="1"/>
  </body>
  <body name="marble" pos="1 0 0.15"><freejoint/>
    <geom type="sphere" size=".1" mass="0.4" condim="1" solref="-2000 -20"/>
  </body>
  <body name="pill" pos="2 0 0.15" quat="0.7 0.7 0.1 0"><freejoint/>
    <geom type="capsule" size=".06 .15" mass="0.6" priority="1" friction="0.3" solref="0.03 0.8"
      solimp="0.7 0.95 0.01 0.3 2"/>
  </body>
  <body name="can" pos="3 0 0.25" quat="0.9 0.3 0 0.1"><freejoint/>
    <geom type="cylinder" size=".1 .15" mass="0.8" solmix="3" solref="0.01 1.2" friction="1.3"/>
  </body>
  <body name="slider" pos="4 0 0.12">
    <joint name="slider_x" type="slide" axis="1 0 0" damping="1"/> <joint name="slider_y" type="slide" axis="0 1 0"/>
    <geom type="box" size=".1 .1 .1" mass="2" contype="2" conaffinity="2" margin="0.01"/>
  </body>
  <body name="pushed" pos="4.35 0.05 0.153"><joint name="pushed_x" type="slide" axis="1 0 0"/>
    <joint name="pushed_y" type="slide" axis="0 1 0"/> <joint name="pushed_yaw" axis="0 0 1"/>
    <geom type="box" size=".2 .1 .15" mass="1" contype="2" conaffinity="3" margin="0.005" friction="0.5"/>
  </body>
  <body name="post" pos="4.9 0 0.2"><geom type="box" size=".1 .5 .2" contype="2" conaffinity="2" condim="1"/></body>
  <body name="leaf_1" pos="-2 0 1">
    <joint name="leaf_1" axis="0 1 0" armature="0.05" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05" mass="0.5" contype="4" conaffinity="4"/>
    <body name="leaf_2" pos="0.5 0 0"><joint name="leaf_2" axis="0 1 0" armature="0.01" range="-2.5 2.5"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05" mass="0.3" contype="4" conaffinity="4"/>
      <body name="leaf_3" pos="0.5 0 0"><joint name="leaf_3" axis="0 1 0.2" armature="0.01"/>
        <geom type="sphere" size="0.08" pos="0.3 0 0" mass="0.2" contype="4" conaffinity="4"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.1" contype="4" conaffinity="4"/>
      </body>
    </body>
  </body>
  <body name="shelf" pos="-2 0 0.6">
    <geom type="box" size="1.2 .2 .05" contype="4" conaffinity="4" margin="0.004"/></body>
  <body name="fork" pos="-4 0 1">
    <joint name="fork" type="slide" axis="0 0 1"/>
    <geom type="box" size=".05 .2 .02" mass="0.5" contype="0" conaffinity="0"/>
    <body name="tine_1" pos="0 0.2 -0.1"><joint name="tine_1" type="slide" axis="0 1 0" range="-0.3 0.3"/>
      <geom type="box" size=".05 .02 .1" mass="0.2" contype="8" conaffinity="8"/></body>
    <body name="tine_2" pos="0 -0.2 -0.1"><joint name="tine_2" type="slide" axis="0 1 0" range="-0.3 0.3"/>
      <geom type="sphere" size=".05" mass="0.2" contype="8" conaffinity="8"/></body>
  </body>
  <body name="held" pos="-4 0 0.9"><freejoint/>
    <geom type="box" size=".04 .04 .05" mass="0.1" contype="8" conaffinity="8" friction="1.5"/>
    <geom type="sphere" size=".03" pos="0 0 .06" mass="0.02" contype="8" conaffinity="8" condim="1"/>
  </body>
</worldbody>
<actuator>
  <velocity joint="slider_x" kv="60" forcerange="-30 30"/> <velocity joint="slider_y" kv="60" forcerange="-30 30"/>
  <motor joint="leaf_1" gear="3"/> <motor joint="leaf_2" gear="1"/> <motor joint="leaf_3" gear="0.4"/>
  <position joint="fork" kp="300" kv="20"/>
  <motor joint="tine_1" gear="-6"/> <motor joint="tine_2" gear="6"/>
</actuator>
</mujoco>
"""
"""Shapes that touch: a floor, one another, within a tree and between trees; each parameter of a contact somewhere."""


def compile_model(text: str, integrator: str = "implicitfast") -> mujoco.MjModel:
    """A model of one of the texts above."""
    return mujoco.MjModel.from_xml_string(text.replace("{option}", OPTION.replace("{integrator}", integrator)))


def starts(model: mujoco.MjModel, worlds: int, *, seed: int = 0, speed: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates ``[W, nq]`` near the model's own and random velocities ``[W, nv]``."""
    rng = np.random.default_rng(seed)
    q, v = np.tile(model.qpos0, (worlds, 1)), speed * rng.normal(size=(worlds, model.nv))
    away = 0.03 * rng.normal(size=(worlds, model.nv))
    for row, step in zip(q, away, strict=True):
        mujoco.mj_integratePos(model, row, step, 1.0)
    return q, v


def controls(model: mujoco.MjModel, steps: int, worlds: int, *, seed: int = 0, held: int = 10) -> np.ndarray:
    """Random controls ``[T, W, nu]``, each held for some steps; what floats can hold."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(-(-steps // held), worlds, model.nu))
    return np.repeat(u, held, axis=0)[:steps].astype(np.float32).astype(float)
