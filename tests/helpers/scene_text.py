# SPDX-License-Identifier: Apache-2.0
"""A small scene to spoil in tests, and a writer of TOML."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

SMALL = """
[[robot]]
name = "base"
asset = "omni_base.urdf"
joint_q = [0.0, 0.0, 0.0]
drive = { damping = 600.0, limit = [0.8, 0.8, 1.0] }
frames.tip = { link = "base_link" }

[[object]]
name = "box"
shape = "box"
size = [0.3, 0.5, 0.3]
mass = 1.0

[[obstacle]]
name = "wall"
shape = "box"
size = [0.6, 0.8, 0.1]
position = [1.0, 1.0, 0.05]

[[obstacle]]
name = "ball"
shape = "sphere"
size = 0.2
position = [-1.0, 1.0, 0.0]

[goal]
object = "box"
position = [2.0, 0.0]

[[cost]]
term = "distance"
between = ["base/tip", "box"]

[[cost]]
term = "contact_force"
between = ["base", "obstacles"]

[planner]
samples = 64
horizon = 16

[success]
position = 0.05

[variants.near]
goal.position = [1.0, 0.0]
obstacle.wall.position = [5.0, 5.0, 0.0]
cost.distance.weight = 7.0
planner.noise.sigma = [0.1, 0.2, 0.3]
"""


def write(folder: Path, text: str = SMALL) -> Path:
    """Write a scene file."""
    path = folder / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


_FLAGS = ("floating", "self_collision", "redraw")
"""Keys that may be left out and for which ``false`` says something else than that."""


def toml(data: dict) -> str:
    """Write tables as TOML; ``None`` becomes ``false``, which switches a key off, and leaves flags out."""
    return "\n".join(_entries(data)) + "\n"


def _entries(data: dict) -> list[str]:
    return [f"{_key(k)} = {_value(v)}" for k, v in data.items() if not (v is None and k in _FLAGS)]


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _text(name)


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: object) -> str:
    if value is None:
        return "false"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, dict):
        return "{" + ", ".join(_entries(value)) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value)
