# SPDX-License-Identifier: Apache-2.0
"""Rollouts of the last plan that are worth a look: which ones, in which colours, and the ways they take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...scene.model.layout import rotate

if TYPE_CHECKING:
    from ...scene.model.layout import Layout
    from ...scene.model.trajectory import Trajectory
    from ...scene.schema import Scene
    from .controller import Controller

FAN = 24
"""Sampled rollouts to draw."""
BEST_COLOR = (255, 60, 60)
LANE, LANE_LENGTH = 2.5, 10.0
"""Distance of the lanes of predicted controls, and how long they are."""

_VIRIDIS = (0x440154, 0x472C7A, 0x3B518B, 0x2C718E, 0x21908D, 0x27AD81, 0x5CC863, 0xAADC32, 0xFDE725)
"""The colour map viridis (matplotlib, CC0) at nine equal steps, from costly to cheap."""


def _color_table(size: int = 256) -> np.ndarray:
    """Packed colours ``[size]`` (red, green, blue, alpha from the highest byte)."""
    anchors = np.array(_VIRIDIS)
    at = np.linspace(0.0, len(anchors) - 1.0, size)
    channel = [np.interp(at, np.arange(len(anchors)), (anchors >> shift) & 0xFF) for shift in (16, 8, 0)]
    red, green, blue = (c.astype(np.uint32) for c in channel)
    return (red << 24) | (green << 16) | (blue << 8) | 0xFF


COLORS = _color_table()


@dataclass(frozen=True)
class RolloutPaths:
    """Paths of the acting frames."""

    best: np.ndarray
    """The cheapest rollout ``[F, T+1, 3]`` [m]."""
    others: np.ndarray
    """Others ``[n, F, T+1, 3]`` [m]."""
    colors: np.ndarray
    """Colours of the others by cost ``[n, 3]``, 0 to 255."""


def see_rollouts(
    controller: Controller, frames: tuple[np.ndarray, np.ndarray], fan: int = FAN
) -> tuple[Trajectory, RolloutPaths] | None:
    """Rollouts of the last plan, the cheapest first, and their paths; None where none survived.

    Args:
        controller: The controller, of one environment, which has planned.
        frames: As :func:`acting_frames`.
        fan: Others, at most.
    """
    worlds, packed = choose_rollouts(controller, fan)
    if not len(worlds):
        return None
    body, place = frames
    seen = controller.engine.record(worlds)
    paths = paths_of(seen.body_q[:, :, body], place)  # [1+n, F, T+1, 3]
    colors = np.stack([(packed >> shift) & 0xFF for shift in (24, 16, 8)], axis=1).astype(np.uint8)
    return seen, RolloutPaths(paths[0], paths[1:], colors)


def choose_rollouts(controller: Controller, fan: int = FAN) -> tuple[np.ndarray, np.ndarray]:
    """Worlds of the cheapest rollout and of others ``[1+n]``, and colours of the others by cost ``[n]``, packed.

    The others are spread evenly over the costs' ranking. The tenth that costs most is of one colour, so that few
    rollouts that went astray do not make all others look alike. There is none, not even the cheapest, when the plan
    fell back to the safe command.

    Args:
        controller: The controller, of one environment, which has planned.
    """
    cost = controller.engine.cost.numpy()[0]
    ranked = np.argsort(cost)
    ranked = ranked[np.isfinite(cost[ranked])]
    if controller.info.fallback or not len(ranked):
        return np.zeros(0, dtype=int), np.zeros(0, dtype=np.uint32)
    chosen = ranked[np.linspace(0, len(ranked) - 1, min(fan, len(ranked))).astype(int)]
    high = cost[ranked[int(0.9 * (len(ranked) - 1))]]
    cheap = np.clip((high - cost[chosen]) / max(high - cost[ranked[0]], 1e-9), 0.0, 1.0)
    worlds = np.concatenate([[controller.info.best], chosen * controller.shape.domains])
    return worlds, COLORS[(cheap * (len(COLORS) - 1)).astype(int)]


def acting_frames(scene: Scene, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Body ``[F]`` and place in it ``[F, 3]`` of the goal's target and of what the robots act with."""
    names = [] if scene.goal is None else [scene.goal.target]
    for robot in scene.robot:
        last = layout.body_name[layout.entity(robot.name).bodies[-1]]
        names += [f"{robot.name}/{frame}" for frame in robot.frames] or [last]
    frames = [layout.frame(name) for name in dict.fromkeys(names)]
    frames = [frame for frame in frames if layout.frame_body[frame] >= 0]
    return layout.frame_body[frames], layout.frame_pose[frames, :3]


def paths_of(pose: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Ways ``[n, F, T+1, 3]`` of places ``[F, 3]`` in bodies with poses ``[T+1, n, F, 7]``."""
    return (pose[..., :3] + rotate(pose[..., 3:], place)).transpose(1, 2, 0, 3).astype(np.float32)


def predicted_lanes(controller: Controller, control: np.ndarray) -> np.ndarray:
    """Controls over the horizon ``[T, nu]`` as lines ``[nu, T, 2]``, one lane below the other.

    To the right is time, the horizon :data:`LANE_LENGTH` long; a lane is 2 high, from upper limit down to the lower.
    """
    lower, upper = controller.limits
    times = controller.plan_step.grid.t[: len(control)]
    share = 2.0 * (control - lower) / (upper - lower) - 1.0
    right = np.broadcast_to(LANE_LENGTH * times / controller.plan_step.grid.t[-1], share.T.shape)
    down = LANE * np.arange(len(lower))[:, None] - share.T
    return np.stack([right, down], axis=-1).astype(np.float32)
