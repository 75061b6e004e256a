# SPDX-License-Identifier: Apache-2.0
"""Models with muscles and with tendons around shapes."""

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
