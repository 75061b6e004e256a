# SPDX-License-Identifier: Apache-2.0
"""Safe commands of a robot's drives, while nobody else commands it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..model.compiled import compile_scene
from ..model.safe import safe_command
from ..scene.schema import SafeCommand
from .gravity import Gravity

if TYPE_CHECKING:
    from ..model.layout import Layout
    from ..model.state import State
    from ..scene.schema import Scene


class SafeCommands:
    """Commands that hold, brake or rest, as each drive is; limits are the caller's.

    Args:
        scene: The scene.
        layout: State layout.

    Raises:
        SceneError: If gravity is to be balanced in a scene without efforts.
    """

    def __init__(self, scene: Scene, layout: Layout):
        self._layout, self._dt = layout, scene.timing.control_dt
        balanced = scene.agent.safe is SafeCommand.GRAVITY
        self._gravity = Gravity(scene, compile_scene(scene)) if balanced else None
        self._held: State | None = None

    def release(self) -> None:
        """Take note that somebody commands the robot again."""
        self._held = None

    def __call__(self, state: State, now: float) -> np.ndarray:
        """The control ``[nu]``: holds are where it was first asked for, brakes act while the robot is known to move.

        Args:
            state: The newest state that can be trusted, with its time.
            now: The robot's clock [s].
        """
        if self._held is None:
            self._held = state
        velocity = state.joint_qd if now - state.time < self._dt else np.zeros_like(state.joint_qd)
        safe = safe_command(self._layout, self._held.joint_q[None], velocity[None], self._dt)[0]
        return safe if self._gravity is None else self._gravity(state, safe)
