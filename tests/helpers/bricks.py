# SPDX-License-Identifier: Apache-2.0
"""A stack of flat shapes."""

import numpy as np

CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * (0.12, 0.1, 0.08)
BRICK = f'<mesh name="mesh" vertex="{" ".join(f"{x:.3f}" for x in CORNERS.ravel())}"/>'
STACK = f"""
<mujoco><option timestep="0.004" integrator="implicitfast"/><asset>{BRICK}</asset><worldbody>
  <geom type="box" size=".5 .5 .1" pos="0 0 -.1"/>
  <body pos="-.3 0 .06"><freejoint/><geom type="cylinder" size=".08 .06" mass="1"/></body>
  <body pos=".2 .2 .08"><freejoint/><geom type="mesh" mesh="mesh" mass="1"/></body>
  <body pos=".2 .21 .2"><freejoint/><geom type="cylinder" size=".07 .04" mass=".5"/></body>
  <body pos=".2 -.3 .05" quat="1 0 1 0"><freejoint/><geom type="cylinder" size=".05 .1" mass=".5"/></body>
</worldbody></mujoco>"""
