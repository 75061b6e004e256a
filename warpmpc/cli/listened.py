# SPDX-License-Identifier: Apache-2.0
"""A robot's sources and joints as tables, as a driver hears them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, TextIO

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from ..kernels.geometry.kinematics import FREE
from ..model.layout import rotate
from ..realtime.watchdog import Watchdog, received
from ..robots.heard import Heard
from .joint_table import joint_table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..model.layout import Layout
    from ..realtime.loop import Robot
    from ..scene.schema import Scene

WIDTH = 160
"""Width of what is printed, but on a terminal."""


class Listened:
    """States of a robot over some seconds, and what its driver heard.

    Args:
        scene: The scene.
        layout: State layout.
        robot: The robot, which has shown a state.
    """

    def __init__(self, scene: Scene, layout: Layout, robot: Robot):
        self._layout, self._robot, self._watchdog = layout, robot, Watchdog(scene, layout)
        self._states = Heard("state", "put together by the driver")
        self._begin = time.monotonic()
        self._faults: dict[str, int] = {}
        self.look()

    def look(self) -> None:
        """Take note of the state as it is now."""
        state = received(self._robot.observe())
        if state.time == self._states.stamp:
            return
        self._state = state
        self._states.note(state.time)
        if (found := self._watchdog.observation_fault(state, state.time)) is not None:
            self._faults[found[1]] = self._faults.get(found[1], 0) + 1

    def show(self, out: TextIO) -> None:
        """Print the sources, then the joints.

        Args:
            out: Where to.
        """
        console = Console(file=out, highlight=False, width=None if out.isatty() else WIDTH)
        console.print(self._sources())
        for why, count in self._faults.items():
            console.print(f"{count} × {why}")
        if np.shape(self._state.joint_q) == (self._layout.nq,):
            console.print(joint_table(self._layout, self._state.joint_q), *self._floating(), sep="\n")
        console.print("nothing was sent")

    def _sources(self) -> Table:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        table.add_column("source")
        for name in ("messages", "rate [Hz]", "age [ms]", "stamp [s]"):
            table.add_column(name, justify="right", no_wrap=True)
        table.add_column("what is wrong")
        for heard in (*getattr(self._robot, "heard", list)(), self._states):
            refused = f"{heard.refused} refused: {heard.problem}" if heard.refused else ""
            rate = "" if np.isnan(heard.rate) else f"{heard.rate:.1f}"
            numbers = (rate, f"{1e3 * heard.age:.1f}", f"{heard.stamp:.3f}") if heard.count else ("", "", "")
            table.add_row(heard.source, str(heard.count), *numbers, heard.missing or refused)
        return table

    def _floating(self) -> Iterator[str]:
        """Lines about where floating bodies are."""
        layout, q = self._layout, self._state.joint_q
        for joint in np.flatnonzero(layout.joint_type == FREE):
            position, quaternion = np.split(q[layout.joint_q_start[joint] :][:7], [3])
            up = np.clip(rotate(quaternion, np.array([0.0, 0.0, 1.0]))[2], -1.0, 1.0)
            where, tilt = ", ".join(f"{number:.3f}" for number in position), np.degrees(np.arccos(up))
            yield f"{layout.joint_name[joint]}: at {where} m, its z axis {tilt:.0f}° from up"
