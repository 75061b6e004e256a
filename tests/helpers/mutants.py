# SPDX-License-Identifier: Apache-2.0
"""Scenes, assets and files of cost terms with a mistake in each, drawn from a seed: what strangers may hand us."""

from __future__ import annotations

import copy
import random
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from scene_text import toml

ARM = """<robot name="arm">
  <link name="base"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/> <child link="upper"/> <origin xyz="0 0 0.1" rpy="0 0 0"/> <axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="20" velocity="3"/>
  </joint>
  <link name="upper">
    <inertial><origin xyz="0.15 0 0"/><mass value="1"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.05 0.05"/></geometry></collision>
  </link>
  <joint name="elbow" type="revolute">
    <parent link="upper"/> <child link="lower"/> <origin xyz="0.3 0 0"/> <axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="20" velocity="3"/>
  </joint>
  <link name="lower">
    <inertial><origin xyz="0.1 0 0"/><mass value="0.5"/>
      <inertia ixx="0.005" iyy="0.005" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="part.stl" scale="0.1 0.1 0.1"/></geometry></visual>
    <collision><geometry><mesh filename="part.stl" scale="0.1 0.1 0.1"/></geometry></collision>
  </link>
</robot>
"""

CART = """<mujoco model="cart">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.01" integrator="implicitfast"/>
  <default><joint damping="0.1"/><geom friction="0.8"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="cart" pos="0 0 0.2">
      <joint name="slide" type="slide" axis="1 0 0" range="-1 1"/>
      <geom name="body" type="box" size="0.1 0.05 0.05" mass="1"/>
      <body name="pole" pos="0 0 0.05">
        <joint name="hinge" type="hinge" axis="0 1 0" range="-3 3"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.1"/>
        <site name="tip" pos="0 0 0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide" gear="10" ctrlrange="-1 1"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
  <keyframe><key name="start" qpos="0 0.1"/></keyframe>
</mujoco>
"""

TERMS = '''"""Cost terms of a stranger."""
import numpy as np
import warp as wp
import warpmpc


@wp.struct
class LeanParams:
    frame: int
    joint: int
    gain: float


@wp.func
def square(x: float) -> float:
    return x * x


@warpmpc.cost_term("lean")
def lean(s: warpmpc.StepView, p: LeanParams) -> float:
    total = float(0.0)
    for i in range(2):
        total += square(warpmpc.joint_velocity(s, i)) + square(warpmpc.control(s, i))
    away = warpmpc.frame_position(s, p.frame) - wp.vec3(0.3, 0.2, 0.1)
    if warpmpc.joint_position(s, p.joint) > 1.0:
        total += p.gain
    return total + p.gain * wp.length(away)


@warpmpc.array_cost("effort")
def effort(batch):
    gain = batch["params"]["gain"]
    return gain * np.square(batch["control"]).sum(axis=-1)
'''

STL = (
    "solid part\n"
    + "".join(
        f"facet normal 0 0 1\nouter loop\nvertex {a}\nvertex {b}\nvertex {c}\nendloop\nendfacet\n"
        for a, b, c in (
            ("0 0 0", "0 1 0", "1 0 0"),
            ("0 0 0", "1 0 0", "0 0 1"),
            ("0 0 0", "0 0 1", "0 1 0"),
            ("1 0 0", "0 1 0", "0 0 1"),
        )
    )
    + "endsolid part\n"
)

PLANNER = """
[timing]
control_dt = 0.04
timeout = 0.12

[planner]
samples = 8
horizon = 3
knots = 3
spline = "cubic"
discount = 0.95
noise = { sigma = { range = 0.2 }, shape = "bspline", spread = [0.5, 1.5], null_share = 0.1 }
temperature = { initial = 1.0, eta = [2.0, 4.0] }

[engine]
name = "mujoco"
threads = 1
substeps = 2
"""

ARM_SCENE = (
    """title = "An arm reaches"
[[robot]]
name = "arm"
asset = "arm.urdf"
joint_q = { shoulder = 0.3, elbow = -0.4 }
frames.tip = { link = "lower", offset = [0.2, 0.0, 0.0] }
drive = { mode = "velocity", joints = ["shoulder", "elbow"], damping = 30.0, effort_limit = [20.0, 10.0], limit = 1.0 }

[[object]]
name = "block"
shape = "box"
size = [0.1, 0.1, 0.1]
mass = 0.5
position = [0.8, 0.3, 0.05]

[[obstacle]]
name = "post"
shape = "cylinder"
size = [0.05, 0.4]
position = [-0.5, 0.5, 0.2]

[goal]
frame = "arm/tip"
position = [0.3, 0.3, 0.1]

[[target]]
name = "via"
position = [0.2, 0.4, 0.1]

[[cost]]
term = "distance"
between = ["arm/tip", "goal"]
weight = 2.0

[[cost]]
name = "slow"
term = "joint_velocity"
weight = 0.1

[[cost]]
term = "lean"
frame = "arm/tip"
joint = "elbow"
gain = 0.5

[[cost]]
term = "effort"
gain = 0.1

[[phase]]
name = "there"
until = { frame = "arm/tip", to = "via", distance = 0.1 }
hold = 0.04

[[phase]]
name = "back"
weight = { slow = 0.2 }

[plant]
substeps = 4
noise = { position = 0.001, velocity = 0.01 }
delay = 0.04
kicks = [{ time = 0.04, target = "block", velocity = [0.1, 0.0, 0.0] }]

[randomize.block]
mass = { uniform = 0.3 }

[randomize_task.draw]
"goal.position" = { low = [0.2, 0.2, 0.1], high = [0.4, 0.4, 0.1] }

[success]
distance = 0.05
hold = 0.04

[variants.near]
goal.position = [0.4, 0.1, 0.1]
"""
    + PLANNER
)

CART_SCENE = (
    """title = "A cart"
ground = false
[[robot]]
name = "cart"
asset = "cart.xml"
keyframe = "start"

[goal]
frame = "cart/tip"
position = [0.0, 0.0, 0.7]

[scalar]
speed = 0.5

[[cost]]
term = "distance"
between = ["cart/tip", "goal"]

[[cost]]
term = "joint_limit"
margin = 0.1

[[cost]]
term = "control_effort"
weight = 0.01

[success]
distance = 0.05
conditions = { joint = "hinge", below = 0.2, above = -0.2 }
"""
    + PLANNER
)

FILES = {
    "arm.urdf": ARM,
    "cart.xml": CART,
    "terms.py": TERMS,
    "part.stl": STL,
    "arm.toml": ARM_SCENE,
    "cart.toml": CART_SCENE,
}
"""A stranger's folder, without a mistake."""

VALUES = [
    0, 1, -1, 2, 1000, 10**9, 10**18, 0.0, -0.0, 0.5, -2.5, 1e-12, 1e-300, 1e12, 1e300, float("nan"), float("inf"),
    True, False, "", "x", "arm", "arm/tip", "goal", "world", "ground", "lower", "auto", "../..", "/dev/null", "ä ö",
    "a" * 300, "arm.urdf", "terms.py", "part.stl", "arm.toml", [], [0.0], [1.0, 2.0], [0.0, 0.0, 0.0], [1e9, 1e9, 1e9],
    [float("nan")] * 3, ["x"], [[]], {}, {"x": 1}, {"uniform": 0.5}, {"low": [0.0], "high": [1.0]}, [{}],
]  # fmt: skip
"""What may stand where something else should."""

NUMBERS = [
    "0",
    "-1",
    "1e9",
    "1e-9",
    "1e300",
    "nan",
    "inf",
    "-inf",
    "",
    "x",
    "1 2",
    "0 0 0",
    "1 0 0 0 0 0 0",
    "3.0.1",
    "1,5",
]
"""What may stand in an asset in place of a number."""

TOKENS = {
    "float": ["int", "str", "wp.vec3", "bool"],
    "int": ["float", "str"],
    "wp": ["np", "warpmpc", "xp"],
    "s": ["p", "t", "None"],
    "p": ["s", "q"],
    "return": ["", "yield", "raise", "print", "assert"],
    "gain": ["gian", "frame"],
    "joint": ["frame", "gain"],
    "i": ["77", "-1", "p", "i + 100"],
    "2": ["-1", "3", "1000", "2.0", "'2'"],
    "0.0": ["0", "wp.nan", "None", "1.0 / 0.0"],
    "1.0": ["1", "wp.inf", "1.0 / 0.0"],
    "x": ["y", "x[0]", "1"],
    "batch": ["None", "dict()"],
    "np": ["wp", "numpy"],
    "+": ["-", "@", "%", "and", "+ 1 +"],
    "*": ["/", "//", "**", "@"],
    "axis": ["axes", "axis=0, axis"],
    "wp.length": ["wp.normalize", "wp.sqrt", "len", "wp.nothing"],
    "square": ["cube", "lean", "effort"],
    "control": ["sensor", "contact_force", "nothing"],
    "joint_velocity": ["joint_position", "frame_position", "step_before"],
    "lean": ["distance", "effort", ""],
    "effort": ["lean", "height"],
    "LeanParams": ["Lean", "float", "object"],
}
"""What may stand in a file of terms in place of something."""


@dataclass(frozen=True)
class Mutant:
    """A stranger's folder with a mistake in it."""

    seed: int
    scene: str
    """Which scene is run."""
    changed: str
    """The file that was changed."""
    content: bytes
    """What is in it."""
    what: str
    """The change, in words."""

    def write(self, folder: Path) -> None:
        """Fill a folder."""
        for name, text in FILES.items():
            (folder / name).write_text(text, encoding="utf-8")
        (folder / self.changed).write_bytes(self.content)


def mutant(seed: int) -> Mutant:
    """The mutant of a seed."""
    rng = random.Random(seed)
    changed = rng.choices(list(FILES), [3, 3, 4, 1, 6, 3])[0]
    scene = "cart.toml" if changed in ("cart.xml", "cart.toml") else "arm.toml"
    text = FILES[changed]
    kinds = {"toml": _scene, "urdf": _asset, "xml": _asset, "py": _terms, "stl": _garbled}
    change = _garbled if rng.random() < 0.15 else kinds[changed.rpartition(".")[2]]
    content, what = change(text, rng)
    return Mutant(seed, scene, changed, content, f"{changed}: {what}")


def _garbled(text: str, rng: random.Random) -> tuple[bytes, str]:
    """Damage on the way: bytes cut off, replaced, inserted, lines lost or doubled."""
    data = bytearray(text.encode())
    at = rng.randrange(len(data))
    match rng.randrange(6):
        case 0:
            return bytes(data[:at]), f"cut off at byte {at}"
        case 1:
            data[at] = rng.randrange(256)
            return bytes(data), f"byte {at} is now {data[at]}"
        case 2:
            data[at:at] = rng.randbytes(8)
            return bytes(data), f"eight bytes inserted at {at}"
        case 3:
            return b"", "emptied"
        case kind:
            lines = text.splitlines(keepends=True)
            n = rng.randrange(len(lines))
            lines[n : n + 1] = [] if kind == 4 else [lines[n]] * 2
            return "".join(lines).encode(), f"line {n + 1} {'lost' if kind == 4 else 'doubled'}"


def _scene(text: str, rng: random.Random) -> tuple[bytes, str]:
    """One or two values replaced, keys lost, renamed or invented, entries doubled."""
    data = tomllib.loads(text)
    said = []
    for _ in range(rng.choice([1, 1, 1, 2])):
        holder, key = rng.choice(list(_places(data)))
        match rng.choices(range(5), [8, 2, 1, 1, 6])[0]:
            case 0:
                holder[key] = copy.deepcopy(rng.choice(VALUES))
                said.append(f"{key} = {str(holder[key])[:60]}")
            case 1:
                del holder[key]
                said.append(f"{key} lost")
            case 2 if isinstance(holder, dict):
                holder[f"{key}s"] = holder.pop(key)
                said.append(f"{key} renamed")
            case 3 if isinstance(holder, list):
                holder.append(copy.deepcopy(holder[key]))
                said.append(f"entry {key} doubled")
            case _ if isinstance(holder[key], int | float):
                holder[key] = holder[key] * rng.choice([-1, 10, 1000, 10**6, 0, 0.01])
                said.append(f"{key} = {holder[key]}")
            case _:
                holder[key] = copy.deepcopy(rng.choice(VALUES))
                said.append(f"{key} = {str(holder[key])[:60]}")
    return toml(data).encode(), "; ".join(said)


def _places(data: object):
    """Every table or list in data with each of its keys."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        yield data, key
        if isinstance(value, dict | list):
            yield from _places(value)


def _asset(text: str, rng: random.Random) -> tuple[bytes, str]:
    """One attribute with another value, without it or under another name; an element renamed, lost or doubled."""
    attribute = rng.choice(list(re.finditer(r'(\w+)="([^"]*)"', text)))
    element = rng.choice(list(re.finditer(r"<(\w+)[^<>]*/>", text)))
    names = re.findall(r'(?:name|link|joint|type)="([^"]*)"', text)
    (a, b), (c, d) = attribute.span(), element.span()
    value = rng.choice(NUMBERS + names)
    match rng.choices(range(5), [10, 2, 2, 3, 2])[0]:
        case 0:
            change, what = (a, b, f'{attribute[1]}="{value}"'), f'{attribute[0]} is now "{value}"'
        case 1:
            change, what = (a, b, ""), f"{attribute[0]} lost"
        case 2:
            change, what = (a, b, f'{attribute[1]}s="{attribute[2]}"'), f"{attribute[0]} renamed"
        case 3:
            change, what = (c, d, ""), f"{element[0]} lost"
        case _:
            change, what = (c, d, element[0] * 2), f"{element[0]} doubled"
    first, end, new = change
    return (text[:first] + new + text[end:]).encode(), what


def _terms(text: str, rng: random.Random) -> tuple[bytes, str]:
    """One word replaced by another one."""
    word = rng.choice(list(TOKENS))
    found = list(re.finditer(rf"(?<![\w.]){re.escape(word)}(?!\w)", text)) or list(re.finditer(re.escape(word), text))
    at, new = rng.choice(found), rng.choice(TOKENS[word])
    line = text[: at.start()].count("\n") + 1
    return (text[: at.start()] + new + text[at.end() :]).encode(), f"line {line}: {word} is now {new!r}"
