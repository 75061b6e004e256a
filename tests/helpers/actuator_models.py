# SPDX-License-Identifier: Apache-2.0
"""Models with muscles, with tendons around shapes, and with every kind of transmission."""

from __future__ import annotations

import numpy as np

ARM = """
<mujoco><compiler angle="radian" autolimits="true"/>
{option}
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <site name="w0" pos="-0.2 0 1.5"/> <site name="w1" pos="-0.2 0.05 1.2"/>
  <body name="upper" pos="0 0 1.3"><joint name="shoulder" type="ball" damping="0.2"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
    <geom name="ball" type="sphere" size="0.06" pos="0.02 0.01 0" mass="0.01"/>
    <geom name="cyl" type="cylinder" size="0.04 0.1" pos="0.3 0 0" euler="1.57 0.1 0" mass="0.01"/>
    <site name="u0" pos="0.12 0 0.05"/> <site name="u1" pos="0.15 0 -0.05"/>
    <site name="sd" pos="0.3 0 -0.1"/> <site name="in" pos="0.3 0.01 0.01"/> <site name="up" pos="0.02 0 0.2"/>
    <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.1" range="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.6"/>
      <site name="f0" pos="0.1 0.01 0.04"/> <site name="f1" pos="0.12 0 -0.05"/> <site name="f2" pos="0.2 0.03 0"/>
      <body pos="0.25 0 0"><joint name="wrist" axis="0 0 1" damping="0.05" armature="0.002"/>
        <geom type="box" size="0.04 0.03 0.02" mass="0.2"/><site name="h0" pos="0.04 0.03 0"/></body>
    </body>
  </body>
</worldbody>
<tendon>
  <spatial name="a" stiffness="20" damping="0.5" springlength="0.2">
    <site site="w0"/><geom geom="ball"/><site site="u0"/></spatial>
  <spatial name="b"><site site="w1"/><geom geom="ball" sidesite="up"/><site site="u1"/><geom geom="cyl" sidesite="sd"/>
    <site site="f1"/></spatial>
  <spatial name="c"><site site="u0"/><geom geom="cyl"/><site site="f0"/><site site="f2"/><pulley divisor="2"/>
    <site site="f2"/><site site="h0"/></spatial>
  <spatial name="d"><site site="u0"/><geom geom="cyl" sidesite="in"/><site site="f0"/></spatial>
</tendon>
<actuator>
  <muscle tendon="b" force="40" lengthrange="0.3 0.7"/>
  <muscle tendon="c" force="-1" scale="60" lengthrange="0.25 0.6" tausmooth="0.2" range="0.7 1.1"/>
  <muscle tendon="d" force="30" lengthrange="0.2 0.5" ctrllimited="true" ctrlrange="0 1"/>
  <general joint="wrist" dyntype="muscle" gaintype="muscle" biastype="muscle" dynprm="0.02 0.05" lengthrange="-1 1"
    gainprm="0.7 1.1 5 200 0.5 1.6 1.5 1.3 1.2"
    biasprm="0.7 1.1 5 200 0.5 1.6 1.5 1.3 1.2"/>
  <motor tendon="a" gear="0.3"/>
</actuator>
</mujoco>
"""

TRANSMISSIONS = """
<mujoco><compiler angle="radian" autolimits="true"/>{option}
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <site name="hook" pos="-2 0.3 2"/> <site name="world" pos="3 0.1 1.4" euler="0.3 0.2 0.1"/>
  <body name="arm_1" pos="0 0 1" gravcomp="0.7">
    <joint name="a1" axis="0 1 0.2" damping="0.05" actuatorgravcomp="true" actuatorfrcrange="-1.5 1"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.04" mass="0.6"/> <site name="elbow" pos="0.06 0.02 0.3"/>
    <body name="arm_2" pos="0 0 0.4" gravcomp="1"><joint name="a2" type="ball" damping="0.05" armature="0.002"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0.1" size="0.04" mass="0.4"/>
      <site name="wrist" pos="0.2 0.05 0.12" euler="0.2 0.5 -0.3"/>
      <body name="arm_3" pos="0.3 0 0.1" gravcomp="0.5">
        <joint name="a3" axis="1 0 0" actuatorgravcomp="true" armature="0.002"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03" mass="0.2"/>
        <site name="tip" pos="0.2 0.02 0"/></body></body>
  </body>
  <body name="bob" pos="-2 0 1" quat="0.9 0.1 0.2 0.1"><freejoint name="bob"/>
    <geom type="box" size=".1 .15 .08" mass="1.2"/>
    <site name="top" pos="0.05 0 .08" euler="0.1 0.2 0.3"/></body>
  <body name="pendulum" pos="2 0 1"><joint name="p1" type="ball" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.04" mass="0.5"/><site name="low" pos="0 0.02 -0.3"/></body>
  <body name="crank" pos="4 0 1"><joint name="c1" axis="0 1 0"/><geom type="cylinder" size="0.1 0.02" mass="1"/>
    <site name="pin" pos="0.1 0 0.02"/></body>
  <body name="slide" pos="4 0 1"><joint name="c2" axis="0 1 0.3" damping="0.1"/>
    <geom type="box" size=".1 .1 .1" mass="2"/><site name="slider" pos="0.02 0 -0.1" euler="0.1 0.2 0"/></body>
  <body name="lift" pos="5 0 1"><joint name="lift" type="slide" axis="0 0 1" damping="2"/>
    <geom type="box" size=".1 .1 .05" mass="1"/><site name="eye" pos="0.05 0 0"/></body>
</worldbody>
<tendon>
  <fixed name="curl" actuatorfrcrange="-0.6 0.5"><joint joint="a1" coef="0.5"/><joint joint="a3" coef="0.3"/></fixed>
  <spatial name="sling" stiffness="20" damping="0.5" springlength="0.8" armature="0.3">
    <site site="hook"/><site site="top"/></spatial>
  <spatial name="rope" armature="0.1" actuatorfrcrange="-1 1">
    <site site="elbow"/><site site="tip"/><pulley divisor="2"/>
    <site site="tip"/><site site="low"/><site site="eye"/></spatial>
</tendon>
<actuator>
  <position tendon="curl" kp="4" kv="0.2"/> <motor tendon="curl" gear="0.5" armature="0.1" damping="0.2"/>
  <velocity tendon="rope" kv="3"/>
  <general tendon="rope" gear="0.5" gainprm="4" biastype="affine" biasprm="0 -2 -0.5" armature="0.2" damping="0.5"/>
  <motor joint="a1" gear="2" armature="0.01" damping="0.05"/>
  <general joint="a2" gear="0.3 0.2 0.5" gaintype="affine" gainprm="2 0.3 0" biastype="affine" biasprm="0.1 -2 -0.1"/>
  <general jointinparent="a2" gear="0.3 0.2 -0.5" gainprm="1" biastype="affine" biasprm="0.1 -1 -0.2"/>
  <motor jointinparent="bob" gear="0.5 0.2 0.3 0.3 -0.2 0.1" armature="0.05" damping="0.3"/>
  <position joint="p1" gear="0.5 0.1 0.2" kp="3"/> <intvelocity joint="p1" gear="0 1 0" kp="2" actrange="-20 20"/>
  <general site="top" refsite="world" gear="0.3 0.2 1 0 0 0" gainprm="3" biastype="affine" biasprm="0 -1 -0.3"/>
  <position site="tip" refsite="elbow" gear="0 0 0 0.3 0.6 0.2" kp="2"/>
  <general site="wrist" refsite="hook" gear="0.3 0 0 0.3 0.6 0.2" gainprm="1" biastype="affine" biasprm="0 -1 -0.1"/>
  <position cranksite="pin" slidersite="slider" cranklength="0.3" gear="1.5" kp="20" kv="1"/>
  <motor cranksite="pin" slidersite="slider" cranklength="0.11" forcerange="-2 2"/>
</actuator>
</mujoco>
"""

_HEAD = """
<mujoco><compiler angle="radian" autolimits="true"/>{option}
<default><geom contype="0" conaffinity="0"/></default><worldbody>"""


def shapes(seed: int, count: int = 9) -> str:
    """Free spheres and cylinders, each with three tendons around it: by no side, one outside, one inside."""
    rng = np.random.default_rng(seed)
    world, tendons = [], []
    for n in range(count):
        radius, at = rng.uniform(0.04, 0.12), np.array([float(n), 0.0, 1.0])
        size = f"{radius:.4f}" if n % 2 else f"{radius:.4f} 0.15"
        sides = {"out": _point(rng, 1.5 * radius), "in": _point(rng, 0.5 * radius)}
        marks = "".join(f'<site name="{side}{n}" pos="{pos}"/>' for side, pos in sides.items())
        world.append(
            f'<body pos="{_text(at)}" quat="{_text(rng.normal(size=4))}"><freejoint/><geom name="shape{n}" '
            f'type="{"sphere" if n % 2 else "cylinder"}" size="{size}" mass="2"/>{marks}</body>'
        )
        for k, side in enumerate(("", "out", "in")):
            way = rng.normal(size=3)
            way *= rng.uniform(1.3, 3.0) * radius / np.linalg.norm(way)
            other = -way * rng.uniform(0.7, 1.5) + rng.normal(size=3) * radius * (1.2 if k < 2 else 2.0)
            for name, off in (("a", way), ("b", other)):
                world.append(f'<site name="{name}{n}_{k}" pos="{_text(at + off)}"/>')
            beside = f' sidesite="{side}{n}"' if side else ""
            tendons.append(
                f'<spatial stiffness="8" damping="0.2"><site site="a{n}_{k}"/><geom geom="shape{n}"{beside}/>'
                f'<site site="b{n}_{k}"/></spatial>'
            )
    return f"{_HEAD}{''.join(world)}</worldbody><tendon>{''.join(tendons)}</tendon></mujoco>"


def _point(rng: np.random.Generator, distance: float) -> str:
    way = rng.normal(size=3)
    return _text(distance * way / np.linalg.norm(way))


def _text(values: np.ndarray) -> str:
    return " ".join(f"{x:.5f}" for x in values)


_CASES = (
    ('sphere" size="0.1', "-0.3 0 0", "0.3 0 0", ""),  # on a line through the centre
    ('cylinder" size="0.1 0.2', "-0.3 0.01 0", "0.05 0 0", ""),  # one end inside
    ('sphere" size="0.1', "-0.3 0.2 0", "0.3 0.2 0.1", ""),  # the way is free
    ('cylinder" size="0.1 0.2', "-0.3 0.2 0.05", "0.3 0.25 0.1", "0.02 0.01 0"),  # from inside
    ('sphere" size="0.1', "-0.3 0.2 0.05", "-0.25 0.2 0.1", "0.02 0.01 0"),  # from inside, ends close together
    ('sphere" size="0.1', "-0.3 0 0.02", "-0.3 0 0.02", "0.2 0 0"),  # ends that are one point
    ('cylinder" size="0.1 0.2', "0.1 0 0.1", "-0.3 0.08 0", "0 0.2 0"),  # one end on the surface
)
DEGENERATE = "".join(
    (
        _HEAD,
        *(
            f'<body pos="{n} 0 1"><joint type="slide" axis="0.3 0.5 0.8"/><joint axis="0.2 0.9 0.1"/>'
            f'<geom name="g{n}" type="{kind}" mass="1"/>'
            + (f'<site name="s{n}" pos="{side}"/>' if side else "")
            + f'</body><body pos="{n} 0 1"><joint type="slide" axis="1 1 1"/><geom size="0.01" mass="1"/>'
            f'<site name="b{n}" pos="{b}"/></body><body pos="{n} 0 1"><site name="a{n}" pos="{a}"/></body>'
            for n, (kind, a, b, side) in enumerate(_CASES)
        ),
        "</worldbody><tendon>",
        *(
            f'<spatial stiffness="20" springlength="0.1"><site site="a{n}"/><geom geom="g{n}"'
            + (f' sidesite="s{n}"' if side else "")
            + f'/><site site="b{n}"/></spatial>'
            for n, (_, _, _, side) in enumerate(_CASES)
        ),
        "</tendon></mujoco>",
    )
)
