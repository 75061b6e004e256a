# SPDX-License-Identifier: Apache-2.0
"""What a controller was given and what it commanded, plan by plan: enough to plan the same again."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..controller.provenance import provenance
from ..model.state import State

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ..controller.controller import Controller
    from ..model.layout import Layout

PREFIX = "log_"
"""How names of a log's arrays begin in a file."""
PARTS = ("joint_q", "joint_qd", "act", "mocap", "time", "task", "lower", "upper", "command")


@dataclass(frozen=True, kw_only=True)
class PlanLog:
    """Inputs and commands of N plans of one controller, of one environment."""

    origin: dict[str, Any]
    """Plain data: scene as text, seed, engine, device, strategy, versions, source, hardware."""
    joint_q: np.ndarray
    """Observed joint coordinates ``[N, nq]``, as all that follows in the precision that is planned with."""
    joint_qd: np.ndarray
    """Observed joint velocities ``[N, nv]``."""
    act: np.ndarray
    """Observed activations ``[N, na]``."""
    mocap: np.ndarray
    """Observed poses of mocap bodies ``[N, nm, 7]``."""
    time: np.ndarray
    """Times of the observations ``[N]`` [s]."""
    task: np.ndarray
    """Poses, scalars and weights at each plan, rows of ``Task.block`` ``[N, n]``."""
    lower: np.ndarray
    """Lower limits of the controls ``[N, nu]``."""
    upper: np.ndarray
    """Upper limits of the controls ``[N, nu]``."""
    command: np.ndarray
    """What the controller returned ``[N, nu]``."""
    clouds: dict[str, dict[int, np.ndarray]]
    """Points ``[n, 3]`` of each cloud by the plan that was the first to see them."""

    def __len__(self) -> int:
        return len(self.time)

    def state(self, n: int) -> State:
        """The observation of plan n."""
        return State(self.joint_q[n], self.joint_qd[n], time=float(self.time[n]), act=self.act[n], mocap=self.mocap[n])

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All of it as arrays by names that begin with :data:`PREFIX`."""
        arrays = {name: getattr(self, name) for name in PARTS}
        arrays["origin"] = np.array(json.dumps(self.origin, ensure_ascii=False))
        for name, seen in self.clouds.items():
            sizes = [len(points) for points in seen.values()]
            arrays[f"cloud/{name}/plan"] = np.array([list(seen), sizes], dtype=int)
            arrays[f"cloud/{name}/points"] = np.concatenate([np.zeros((0, 3), np.float32), *seen.values()])
        return {PREFIX + name: array for name, array in arrays.items()}

    @classmethod
    def from_arrays(cls, data: Mapping[str, np.ndarray]) -> PlanLog | None:
        """The log that :meth:`to_arrays` wrote; None where there is none.

        Raises:
            KeyError: If a part is missing.
            ValueError: If a part is something else.
        """
        found = {name.removeprefix(PREFIX): data[name] for name in data if name.startswith(PREFIX)}
        if not found:
            return None
        clouds = {}
        for name in found:
            if name.startswith("cloud/") and name.endswith("/plan"):
                plans, sizes = found[name].tolist()
                parts = np.split(found[name.removesuffix("plan") + "points"], np.cumsum(sizes)[:-1])
                clouds[name.split("/")[1]] = dict(zip(plans, parts, strict=False))
        return cls(origin=json.loads(str(found["origin"])), clouds=clouds, **{name: found[name] for name in PARTS})


class PlanLogger:
    """Takes note of a controller's plans.

    Args:
        controller: The controller, of one environment.
        details: More about where the run comes from, plain data, for the log's origin.
    """

    def __init__(self, controller: Controller, details: Mapping[str, Any] | None = None):
        self._controller = controller
        self._details = dict(details or {})
        self._late = controller.info is not None
        self._rows: list[tuple[np.ndarray, ...]] = []
        self._clouds: dict[str, dict[int, np.ndarray]] = {cloud.name: {} for cloud in controller.scene.cloud}
        self._newest: dict[str, np.ndarray] = {}

    def log(self) -> None:
        """Take note of the last plan."""
        controller = self._controller
        state, (lower, upper) = controller.observed, controller.limits
        task = controller.planned_task[0]
        times = np.array(state.time)
        self._rows.append(
            (state.joint_q, state.joint_qd, state.act, state.mocap, times, task, lower, upper, controller.command)
        )
        for name, seen in self._clouds.items():
            points = controller.task.points(name)
            if points is not self._newest.get(name):  # nobody changes them in place
                seen[len(self._rows) - 1] = points.astype(np.float32)
                self._newest[name] = points

    @property
    def plans(self) -> PlanLog:
        """The plans so far."""
        controller, layout, count = self._controller, self._controller.layout, len(self._rows)
        columns = zip(*self._rows, strict=True) if count else ((),) * len(PARTS)
        widths = _shapes(layout, controller.task.block.shape[1])
        dtypes = [float if name == "time" else np.float32 for name in PARTS]
        parts = {
            name: np.array(column, dtype=dtype).reshape(count, *shape)
            for name, column, shape, dtype in zip(PARTS, columns, widths, dtypes, strict=True)
        }
        about = {**provenance(controller), "from_start": not self._late, **self._details}
        return PlanLog(origin=about, clouds=self._clouds, **parts)


def _shapes(layout: Layout, task: int) -> list[tuple[int, ...]]:
    """Shape of one row of each part."""
    nu = layout.nu
    return [(layout.nq,), (layout.nv,), (layout.na,), (layout.nm, 7), (), (task,), (nu,), (nu,), (nu,)]
