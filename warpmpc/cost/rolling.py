# SPDX-License-Identifier: Apache-2.0
"""The cost term of a ball on a tray: how its keys in scene files become kernel parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..kernels.geometry.kinematics import FREE
from ..kernels.terms import rolling
from ..scene.errors import SceneError
from ..scene.types import Flag, NonNegative, Positive, Section
from .term import CostTerm, parse_keys

if TYPE_CHECKING:
    from .binding import Binding

GRAVITY = 9.81
"""[m/s²], as in every scene."""


class RollingBall(Section):
    """Squared distance of a rolling ball from the origin of a frame, by a motion of its own."""

    ball: str
    """Object that rolls; it starts where it is observed."""
    on: str
    """Frame on whose plane z = 0 it rolls; the origin is where the ball belongs."""
    share: Positive = 5.0 / 7.0
    """Share of the acceleration that a frictionless point would have; 5/7 for a solid ball, 1 in STORM."""
    carried: Flag = True
    """Whether the frame's own acceleration counts, too; not in STORM."""
    time: NonNegative = 0.5
    """How long of its way counts as distance when the ball moves [s]."""


def _rolling_ball(keys: dict[str, Any], b: Binding) -> rolling.RollingBallParams:
    v = parse_keys(RollingBall, keys, b)
    shape, layout = b.object_shape(v.ball, "ball"), b.layout
    if shape.kind != "sphere":
        raise SceneError("only spheres roll like this", key=f"{b.key}.ball", file=b.file, found=shape.kind)
    joint = int(np.flatnonzero(layout.joint_child == shape.body)[0])
    if int(layout.joint_type[joint]) != int(FREE):
        raise SceneError("this object does not move freely", key=f"{b.key}.ball", file=b.file, found=v.ball)
    p = rolling.RollingBallParams()
    p.memory, p.ball, p.on = b.carry(4), b.frame(v.ball, "ball"), b.frame(v.on, "on")
    p.velocity = int(layout.joint_qd_start[joint])
    p.share, p.carried, p.gravity, p.time = v.share, float(v.carried), GRAVITY, v.time
    return p


TERMS = (
    CostTerm(
        "rolling_ball",
        rolling.rolling_ball,
        rolling.RollingBallParams,
        _rolling_ball,
        RollingBall,
        advance=rolling.roll,
    ),
)
"""Cost terms of balls on trays."""
