# SPDX-License-Identifier: Apache-2.0
"""Number of physics steps in a step of a rollout where a scene leaves it out: few, as long as plans hardly change."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ..launch import capturing
from ..model.batch_size import BatchSize
from ..model.layout import rotate
from ..model.mujoco_model import Options
from ..model.safe import safe_command
from ..task.observed import ObservedState
from ..task.task import Task, task_layout

if TYPE_CHECKING:
    from ..model.compiled import CompiledScene
    from ..scene.schema import Scene
    from .timegrid import TimeGrid

LONGEST = 0.01
"""Longest step that is chosen [s]: MuJoCo softens contacts whose time constant, 0.02 s by default, is less than two."""
FACTORS = (4, 2)
"""Numbers of the MJCF file's steps that are put into one: the first that will do is taken."""
SMALL = 0.01
"""Error that is small, as a share of the spread of the rollouts: planning compares rollouts, and those that differ a
hundred times as much as a longer step moves them keep their order. Robots with legs are at 0.15 and more, arms and
carts below 0.03; a hand that turned an egg in two of two runs did in one with twice the step, at 0.02."""
WORLDS = 16
"""Rollouts that are compared."""
MOVES = 0.05
"""Share of the largest spread below which a body is not moved by the controls."""
KNOTS = 6
"""Random controls of a rollout, between which they are interpolated."""


def physics_step_count(scene: Scene, compiled: CompiledScene, grid: TimeGrid, count: int) -> int:
    """Number of physics steps in the first step of a rollout.

    Random controls of small to large amplitude are rolled out over the horizon with the file's step and with longer
    ones, always the same controls.

    Args:
        scene: The scene.
        compiled: The scene, compiled from MJCF files.
        grid: Steps of the rollout.
        count: What it is with the file's step.
    """
    dt = float(grid.dt[0])
    counts = dict.fromkeys(n for n in (math.ceil(count / k) for k in FACTORS) if n < count and dt / n <= LONGEST + 1e-9)
    fitting = [n for n in counts if np.abs(grid.dt * n / dt - np.round(grid.dt * n / dt)).max() < 1e-6]
    if not fitting or not compiled.layout.nu:
        return count
    key, known = f"{scene.engine.model_dump_json()} {grid.dt.tolist()}", compiled.measured
    if key not in known:
        with capturing:  # nothing may be allocated while a controller records its plan
            rollouts = _Rollouts(scene, compiled, grid)
            exact = rollouts.centres(count)
            known[key] = next((n for n in fitting if _error(rollouts.centres(n), exact) <= SMALL), count)
    return known[key]


class _Rollouts:
    """Random controls from a scene's start.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        grid: Steps of the rollouts.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene, grid: TimeGrid):
        self._scene, self._compiled, self._grid = scene, compiled, grid
        self._layout = layout = task_layout(compiled.layout, scene)
        self._state = ObservedState.allocate(layout, Task(scene), "cpu")
        lower, upper = layout.control_lower.astype(float), layout.control_upper.astype(float)
        start = safe_command(layout, layout.joint_q[None], np.zeros((1, layout.nv)), float(grid.dt[0]))[0]
        amplitude = np.geomspace(0.1, 1.0, WORLDS)[:, None, None] * (upper - lower) / 2.0
        knots = amplitude * np.random.default_rng(0).uniform(-1.0, 1.0, (WORLDS, KNOTS, layout.nu))
        place = (KNOTS - 1) * grid.t[:-1] / max(grid.t[-2], 1e-9)
        first = np.minimum(place.astype(int), KNOTS - 2)
        share = (place - first)[:, None]
        control = knots[:, first] * (1.0 - share) + knots[:, first + 1] * share
        self._control = np.clip(start + control, lower, upper).swapaxes(0, 1)

    def centres(self, count: int) -> np.ndarray:
        """Centres of mass of all bodies ``[T+1, W, nb, 3]``, not finite in a world that diverges.

        Args:
            count: Physics steps in the first step of the rollouts.
        """
        from .mujoco import MujocoSimulator

        length = float(self._grid.dt[0]) / count
        simulator = MujocoSimulator(
            self._compiled,
            BatchSize(1, WORLDS, 1, self._grid.steps),
            substeps=np.round(self._grid.dt / length).astype(int).tolist(),
            timestep=length,
            options=Options.of(self._scene.engine),
            sensors=(),
            threads=1,
        )
        simulator.trajectory.control.assign(self._control.astype(np.float32))
        simulator.clone(self._state)
        simulator.rollout(simulator.trajectory.control)
        poses = simulator.trajectory.body_q.numpy().astype(float)
        centres = poses[..., :3] + rotate(poses[..., 3:], self._layout.body_com)
        centres[:, simulator.trajectory.diverged.numpy().astype(bool)] = np.nan
        simulator.close()
        return centres


def _error(centres: np.ndarray, exact: np.ndarray) -> float:
    """Difference of rollouts ``[T+1, W, nb, 3]``, as a share of how far they are from one another.

    Root mean square over worlds and steps, of the body for which it is largest among those that the controls move;
    infinite where a world diverges.
    """
    if not (np.isfinite(centres).all() and np.isfinite(exact).all()):
        return math.inf

    def size(apart: np.ndarray) -> np.ndarray:
        return np.sqrt((apart**2).sum(axis=-1).mean(axis=(0, 1)))

    spread = size(exact - exact.mean(axis=1, keepdims=True))
    moved = (spread > 0.0) & (spread >= MOVES * spread.max(initial=0.0))
    return float((size(centres - exact)[moved] / spread[moved]).max(initial=0.0)) if moved.any() else math.inf
