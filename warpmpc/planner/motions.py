# SPDX-License-Identifier: Apache-2.0
"""Stored motions, of which those that began in a state near the observed one are tried among the samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..kernels.geometry.kinematics import BALL, FREE
from ..model.assets import resolve_asset
from ..model.npz import read_npz
from ..scene.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ..model.layout import Layout
    from ..model.state import State
    from ..scene.schema import Ancillary, Scene
    from .horizon import Ask, Horizon

LEAST_SPREAD = 1e-6
"""Numbers that vary less over a file say nothing about what is near [m, rad, m/s, rad/s]."""


def motions(scene: Scene, layout: Layout, key: str, wanted: Ancillary, horizon: Horizon) -> tuple[int, Ask]:
    """Number of motions of a file that are tried, and the function that selects them.

    Raises:
        SceneError: If the file is missing or does not fit, or there is no such joint.
    """
    base = None if scene.path is None else scene.path.parent
    path = resolve_asset(wanted.motions, base=base, key=key, file=scene.path)
    try:
        with read_npz(path) as file:
            arrays = {name: np.asarray(file[name], float) for name in _NAMES if name in file.files}
        states, controls = _motions(arrays, layout, horizon)
    except (OSError, ValueError, TypeError) as error:
        raise SceneError(f"is no file of motions: {error}", key=key, file=scene.path, found=wanted.motions) from None
    if len(states) < wanted.nearest:
        nearest = key.replace("motions", "nearest")
        message = f"the file has {len(states)} motions"
        raise SceneError(message, key=nearest, file=scene.path, found=wanted.nearest)
    near = Nearness(layout, states, near_columns(layout, key.replace("motions", "joints"), wanted.joints))
    knots = horizon.knots(controls)

    def ask(state: State, task: Mapping[str, np.ndarray | float]) -> np.ndarray:
        distance = near(np.concatenate([state.joint_q, state.joint_qd]))
        return knots[np.argsort(distance, kind="stable")[: wanted.nearest]]

    return wanted.nearest, ask


class Nearness:
    """Distances of states from stored ones, every number counted by its spread over those.

    A quaternion is compared with the sign that brings it nearer, the angle of a joint that turns without end the short
    way round.

    Args:
        states: Stored joint coordinates and velocities ``[N, nq + nv]``.
        columns: Numbers that count.
    """

    def __init__(self, layout: Layout, states: np.ndarray, columns: np.ndarray):
        self._states, self._columns = states, columns
        starts = zip(layout.joint_type.tolist(), layout.joint_q_start.tolist(), strict=True)
        first = {int(BALL): 0, int(FREE): 3}
        self._quaternions = [slice(at + first[kind], at + first[kind] + 4) for kind, at in starts if kind in first]
        self._endless = endless_coordinates(layout, turning=True)
        spread = self._differences(states[0]).std(axis=0)
        self._scale = np.divide(1.0, spread, out=np.zeros_like(spread), where=spread > LEAST_SPREAD)

    def __call__(self, state: np.ndarray) -> np.ndarray:
        """Distances ``[N]`` of a state ``[nq + nv]``."""
        return np.linalg.norm((self._differences(state) * self._scale)[:, self._columns], axis=1)

    def _differences(self, state: np.ndarray) -> np.ndarray:
        out = self._states - state
        for part in self._quaternions:
            opposite = self._states[:, part] @ state[part] < 0.0
            out[opposite, part] = self._states[opposite, part] + state[part]
        out[:, self._endless] = (out[:, self._endless] + np.pi) % (2.0 * np.pi) - np.pi
        return out


_NAMES = ("joint_q", "joint_qd", "control", "time")


def _motions(arrays: dict[str, np.ndarray], layout: Layout, horizon: Horizon) -> tuple[np.ndarray, np.ndarray]:
    """States ``[N, nq + nv]`` and the controls ``[N, T, nu]`` that followed them.

    Raises:
        ValueError: If an array is missing, has the wrong shape or is not finite.
    """
    missing = [name for name in _NAMES if name not in arrays]
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    control, time = arrays["control"], arrays["time"]
    if control.ndim not in (2, 3) or not len(control) or control.shape[-1] != layout.nu:
        raise ValueError(f"control is {list(control.shape)}, not [N, K, {layout.nu}] or, of a run, [N, {layout.nu}]")
    count = len(control)
    held = control.shape[1] if control.ndim == 3 else count
    recorded = control.ndim == 2  # a run has a state more than controls, the one it ended in
    for name, shape in (("joint_q", layout.nq), ("joint_qd", layout.nv)):
        if arrays[name].shape != (count + recorded, shape):
            raise ValueError(f"{name} is {list(arrays[name].shape)}, not [{count + recorded}, {shape}]")
    if time.shape != (held + recorded,) or np.any(np.diff(time) <= 0.0):
        raise ValueError(f"time is {list(time.shape)}, not {held + recorded} ascending numbers")
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise ValueError("it has numbers that are not finite")
    states = np.concatenate([arrays["joint_q"], arrays["joint_qd"]], axis=1)[:count]
    if recorded:
        at = time[:count, None] + horizon.time
        return states, control[holding(time[:count], at)]
    return states, control[:, holding(time, horizon.time)]


def endless_coordinates(layout: Layout, *, turning: bool) -> np.ndarray:
    """Coordinates of the joints that turn, or else slide, without end."""
    linear, angular = layout.joint_dof_dim.T
    turns = np.concatenate([np.arange(n) >= k for k, n in zip(linear, linear + angular, strict=True)])
    endless = (turns == turning) & (layout.dof_upper - layout.dof_lower > 1e3) & (layout.dof_coord >= 0)
    return layout.dof_coord[endless]


def holding(time: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Index of the control that acts at other times, of those that begin at ascending times; the ends are held."""
    early = 1e-6  # a step that begins with a control has it, however the two times were rounded
    return np.clip(np.searchsorted(time, at + early, side="right") - 1, 0, len(time) - 1)


def near_columns(layout: Layout, key: str, joints: Sequence[str] | None) -> np.ndarray:
    """Numbers of a state ``[nq + nv]`` that say what is near.

    Args:
        joints: Their names, all of them if None.

    Raises:
        SceneError: If there is no such joint.
    """
    if joints is None:
        return np.arange(layout.nq + layout.nv)
    coords = [layout.joint(name, key=key) for name in joints]
    return np.concatenate([coords, layout.nq + np.flatnonzero(np.isin(layout.dof_coord, coords))])
