# SPDX-License-Identifier: Apache-2.0
"""Data sets of demonstrations for learning: HDF5 files as robomimic reads them.

Demonstrations: what a planner saw and what it did, from a run log.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...physics.runtime.files import require_space, try_file, writing
from ...scene.task.task import Task
from ..record.replay import logged_scene, require_plans

if TYPE_CHECKING:
    import h5py

    from ...loop.log.run_log import RunLog

NEEDED = {"mcap": ("mcap", "rosbags"), "hdf5": ("h5py",)}
"""Packages by format."""
GYMNASIUM = 2
"""Kind of environment in robomimic's ``env_args``."""
OVERHEAD = 1 << 20
"""More than HDF5 needs for an episode besides its numbers [bytes]."""


def require(kind: str) -> None:
    """Refuse a format whose packages are not installed.

    Raises:
        ValueError: If one is not.
    """
    if missing := [package for package in NEEDED[kind] if find_spec(package) is None]:
        raise ValueError(f'--{kind} needs {" and ".join(missing)}: pip install "warpmpc[export]"')


class Hdf5DataSet:
    """An HDF5 file in robomimic's layout; every episode is in it when :meth:`add` returns.

    ``data/demo_I`` has ``actions``, ``rewards``, ``dones``, ``obs/NAME``, ``next_obs/NAME`` and ``time``, and the
    attributes ``num_samples``, ``seed``, ``success`` and ``reason``; ``mask/success`` names those that reached
    their goal. ``data`` has the attributes ``total`` and ``env_args``.

    Args:
        path: A new file.

    Raises:
        ValueError: If it is there already, has another ending, or h5py is missing.
        OSError: If it cannot be written.
    """

    def __init__(self, path: Path):
        require("hdf5")
        if path.suffix not in (".hdf5", ".h5"):
            raise ValueError(f"--hdf5: '{path}' is no .hdf5 file: give another name")
        if os.path.exists(path):
            raise ValueError(f"'{path}' is there already: give a new name, a data set is of one kind")
        if not path.absolute().parent.is_dir():
            raise ValueError(f"'{path}': no such folder: {path.absolute().parent}")
        try_file(path)
        self.name, self.steps = str(path), 0
        self._path, self._file = path, None
        self._successful: list[str] = []
        self._count = 0

    def add(self, demonstration: Demonstration) -> None:
        """Add an episode.

        Raises:
            OSError: If the file cannot be written.
        """
        require_space(self._path, OVERHEAD + demonstration.nbytes)
        with writing(self._path):
            self._add(demonstration)

    def _add(self, demonstration: Demonstration) -> None:
        """Write an episode; HDF5 ends the process where the disk is full."""
        if self._file is None:
            self._file = self._begin(demonstration)
        name = f"demo_{self._count}"
        group = self._file["data"].create_group(name)
        arrays = {"actions": demonstration.actions, "rewards": demonstration.rewards}
        arrays |= {"dones": demonstration.ends.astype(np.uint8), "time": demonstration.time[:-1]}
        arrays |= {f"obs/{key}": rows[:-1] for key, rows in demonstration.observations.items()}
        arrays |= {f"next_obs/{key}": rows[1:] for key, rows in demonstration.observations.items()}
        for key, rows in arrays.items():
            group.create_dataset(key, data=rows, compression="gzip")
        about = {"num_samples": len(demonstration), "seed": demonstration.origin["seed"]}
        about |= {"success": demonstration.success, "reason": demonstration.reason}
        for key, value in about.items():
            if value is not None:
                group.attrs[key] = value
        self._count, self.steps = self._count + 1, self.steps + len(demonstration)
        self._file["data"].attrs["total"] = self.steps
        if demonstration.success:
            self._successful.append(name)
            self._file.pop("mask/success", None)
            self._file["mask/success"] = np.array(self._successful, dtype="S")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def _begin(self, first: Demonstration) -> h5py.File:
        import h5py

        file = h5py.File(self._path, "x")
        kwargs = {"names": first.names, "limits": first.limits.tolist(), "origin": first.origin}
        about = {"env_name": first.origin["scene"], "type": GYMNASIUM, "env_kwargs": kwargs}
        file.create_group("data").attrs["env_args"] = json.dumps(about, ensure_ascii=False)
        return file


@dataclass(frozen=True, kw_only=True)
class Demonstration:
    """One episode of N controls, in float32 as a planner has it."""

    observations: dict[str, np.ndarray]
    """What was observed before each control, by name, ``[N + 1, n]``: ``joint_q``, ``joint_qd``, ``act``, ``mocap``,
    and poses (x, y, z, qx, qy, qz, qw) and scalars of the task, as ``planner.ancillary.observation`` names them. The
    last row is the true state at the end, with activations, mocap poses and the task as they were before it."""
    actions: np.ndarray
    """Controls that were applied ``[N, nu]``, in the units of the drives."""
    time: np.ndarray
    """Times of the states ``[N + 1]`` [s]."""
    limits: np.ndarray
    """Lower and upper limits of the controls ``[2, nu]``, those of the last plan."""
    names: dict[str, list[str]]
    """Names of the numbers of ``joint_q``, ``joint_qd`` and ``controls``."""
    origin: dict[str, Any]
    """Plain data: scene as text, seed, engine, strategy, versions."""
    success: bool | None = None
    """Whether the goal was reached; None where that is not known."""
    reason: str | None = None
    """Its end in words; None where that is not known."""

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def nbytes(self) -> int:
        """Size of its numbers [bytes], those of observations twice, as the next ones are kept, too."""
        return self.actions.nbytes + self.time.nbytes + 2 * sum(rows.nbytes for rows in self.observations.values())

    @property
    def rewards(self) -> np.ndarray:
        """One for the control that reached the goal, else zero ``[N]``."""
        return np.where(self.ends, 1.0, 0.0).astype(np.float32) * bool(self.success)

    @property
    def ends(self) -> np.ndarray:
        """Return whether each control is the last ``[N]``."""
        return np.arange(1, len(self) + 1) == len(self)


def demonstration(log: RunLog, *, success: bool | None = None, reason: str | None = None) -> Demonstration:
    """Make a demonstration of a run log.

    In real time a step is a tick; those before the first plan, and those at which nothing was sent or nothing finite
    was observed, are left out.

    Args:
        log: The log, with its plans.
        success: Whether the episode reached its goal, None where that is not known.
        reason: Its end in words, None where that is not known.

    Raises:
        SceneError: If this version of warpmpc cannot read the scene.
        ValueError: If the log lacks what its plans were made from, or nothing was sent.
    """
    require_plans(log)
    plan, controls = log.plan_rows(), log.controls
    if log.real_time:
        seen = {"joint_q": controls.seen_q, "joint_qd": controls.seen_qd, "act": controls.seen_act}
        seen["mocap"] = controls.seen_mocap
        finite = [np.isfinite(rows.reshape(len(rows), -1)).all(axis=1) for rows in (*seen.values(), controls.control)]
        kept = np.flatnonzero((plan >= 0) & np.all(finite, axis=0))
    else:
        seen = {name: log.plans[name][plan] for name in ("joint_q", "joint_qd", "act", "mocap")}
        kept = np.arange(len(controls))
    if not len(kept):
        raise ValueError("the log has no control that a plan sent")
    end = log.states[kept[-1] + 1]
    seen = {name: rows[kept].reshape(len(kept), -1) for name, rows in seen.items() if rows.size}
    last = {"joint_q": end.joint_q, "joint_qd": end.joint_qd}
    observations = {name: np.vstack([rows, last.get(name, rows[-1])]) for name, rows in seen.items()}
    observations |= task_values(Task(logged_scene(log)), log.plans.task[plan[[*kept, kept[-1]]]])
    newest = log.plans[plan[kept[-1]]]
    return Demonstration(
        observations={name: rows.astype(np.float32) for name, rows in observations.items()},
        actions=controls.control[kept].astype(np.float32),
        time=log.states.time[[*kept, kept[-1] + 1]],
        limits=np.stack([newest.lower, newest.upper]),
        names={name: list(log.names[name]) for name in ("joint_q", "joint_qd", "controls")},
        origin=log.origin,
        success=success,
        reason=reason,
    )


def task_values(task: Task, block: np.ndarray) -> dict[str, np.ndarray]:
    """Poses and scalars of a task by name ``[N, 7]`` and ``[N, 1]``.

    Args:
        task: A task of the same scene; it is changed.
        block: Its rows of values ``[N, ...]`` (``Task.block``).
    """
    rows, which = np.unique(block, axis=0, return_inverse=True)
    values: list[dict[str, np.ndarray | float]] = []
    for row in rows:
        task.follow(row)
        values.append(task.values())
    named = {name: np.stack([np.atleast_1d(value[name]) for value in values]) for name in task.values()}
    return {name: found[which] for name, found in named.items()}
