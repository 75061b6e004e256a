# SPDX-License-Identifier: Apache-2.0
"""Blocks in the way of a push, the grid over them, and who pushes what."""

import math

import numpy as np
from small_scenes import compiled, make_scene

from warpmpc.cost.resources.geodesic import Grid
from warpmpc.cost.resources.push_value import PushRequest

YAWS = [0.0, 0.2, 0.7, np.pi / 4]


def block(name="block", *, size=(0.4, 0.8, 0.4), position=(0.5, 0.3), yaw=0.0) -> dict:
    rotation = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return {"name": name, "shape": "box", "size": size, "position": (*position, size[2] / 2), "rotation": rotation}


def make_grid(*obstacles: dict, cell: float = 0.1, reach: float = 1.0) -> Grid:
    layout = compiled(make_scene(obstacle=obstacles)).layout
    return Grid(layout, np.array([[-reach, -reach], [reach, reach]]), cell=cell)


def request(**changes) -> PushRequest:
    """A box of 0.3 × 0.5 m and a pusher of 0.2 × 0.3 m."""
    sizes = {"inflation": 0.23, "half_size": (0.15, 0.25), "faces": True, "width": 0.2, "length": 0.3}
    return PushRequest(**{**sizes, "turn": 1.0, "slant": 1.5, **changes})


def round_request(radius: float = 0.2, **changes) -> PushRequest:
    return request(half_size=(radius, radius), faces=False, **changes)
