# SPDX-License-Identifier: Apache-2.0
"""A scene with everything that a page reads out: joints with and without a range, sensors, norms with parameters."""

from __future__ import annotations

from pathlib import Path

MODEL = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.01" iterations="7" integrator="implicitfast"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="swing" axis="0 1 0" range="-1.5 2" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.04" mass="1.5"/>
      <body name="wheel" pos="0 0 -0.5">
        <joint name="turn" axis="0 1 0" damping="0.01"/>
        <geom type="cylinder" euler="1.5708 0 0" size="0.1 0.02" mass="0.5"/>
        <site name="hub"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="swing" joint="swing" gear="4" ctrlrange="-1 1"/>
    <motor name="turn" joint="turn" gear="0.2" ctrlrange="-1 1"/>
  </actuator>
  <sensor><jointpos name="angle" joint="swing"/><gyro name="spin" site="hub"/></sensor>
</mujoco>
"""
SCENE = """
title = "A wheel on an arm"

[timing]
control_dt = 0.02

[engine]
name = "mujoco"
threads = 1
iterations = 5

[[robot]]
name = "arm"
asset = "swinging.xml"

[[cost]]
name = "lift"
term = "position_residual"
of = "arm/wheel"
axes = "z"
norm = { kind = "smooth_abs", p = 0.1 }
weight = 5.0

[[cost]]
name = "still"
term = "joint_velocity_residual"
of = "arm"
norm = { kind = "power", p = 1.5 }
weight = 0.01

[planner]
samples = 16
lookahead = 0.4
dt = 0.04
"""


def write_swinging(folder: Path) -> str:
    """Write model and scene into a folder; returns the scene's path."""
    (folder / "swinging.xml").write_text(MODEL)
    (folder / "swinging.toml").write_text(SCENE)
    return str(folder / "swinging.toml")
