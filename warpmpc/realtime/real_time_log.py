# SPDX-License-Identifier: Apache-2.0
"""What plans in real time were made from and what they came to: enough to make the same plans again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..model.state import State
from .letters import Sighting

PREFIX = "made_"
"""How names of a log's arrays begin in a file."""
TIMES = ("time", "reach", "latency", "plan_ms", "knot_time", "cost", "beta", "eta", "terms")
"""What is kept in double precision."""


@dataclass(frozen=True, kw_only=True)
class RealTimeLog:
    """Inputs and outcome of N plans of a planner in real time, those of its processes that died among them.

    Plans have P knots of ``nu`` controls, costs have K terms. Times are the robot's, unless they are said to be wall
    times.
    """

    origin: dict[str, Any]
    """Plain data: scene as text, seed, engine, device, strategy, versions, source, hardware."""
    life: np.ndarray
    """Which of the planners that followed one another made each plan ``[N]``."""
    number: np.ndarray
    """Its number, as agents know it ``[N]``; one that its planner did not live to hand over has that of the next."""
    time: np.ndarray
    """Times of the observations ``[N]`` [s]."""
    joint_q: np.ndarray
    """Observed joint coordinates ``[N, nq]``, as all numbers of robots in the precision that is planned with."""
    joint_qd: np.ndarray
    """Observed joint velocities ``[N, nv]``."""
    act: np.ndarray
    """Observed activations ``[N, na]``, NaN where they were left out."""
    mocap: np.ndarray
    """Observed poses of mocap bodies ``[N, nm, 7]``, NaN where they were left out."""
    command: np.ndarray
    """What the robot was sent last ``[N, nu]``."""
    following: np.ndarray
    """Whether that came from a plan ``[N]``: then the last one with a surviving rollout is what acts until this one."""
    task: np.ndarray
    """Poses, scalars and weights, rows of ``Task.block`` ``[N, n]``."""
    lower: np.ndarray
    """Lower limits of the controls ``[N, nu]``."""
    upper: np.ndarray
    """Upper limits of the controls ``[N, nu]``."""
    reach: np.ndarray
    """How far the observation was predicted forward ``[N]`` [s]."""
    latency: np.ndarray
    """From the observation to the plan ``[N]`` [s]."""
    plan_ms: np.ndarray
    """Wall time of the planning itself ``[N]`` [ms]."""
    survived: np.ndarray
    """Whether any rollout survived ``[N]``."""
    cost: np.ndarray
    """Cost of the plan's best sample ``[N]``."""
    terms: np.ndarray
    """What each term adds to it, with its weight and discounted ``[N, K]``."""
    beta: np.ndarray
    """Temperature β ``[N]``."""
    eta: np.ndarray
    """Effective number of samples η ``[N]``."""
    knot_time: np.ndarray
    """When each knot of the plan stands ``[N, P]`` [s]."""
    knots: np.ndarray
    """The plan ``[N, P, nu]``."""
    term_names: tuple[str, ...]
    """Names of the cost terms ``[K]``."""

    def __len__(self) -> int:
        return len(self.time)

    def sighting(self, n: int) -> Sighting:
        """What the planner was told before plan n."""
        act, mocap = (None if np.isnan(part).any() else part for part in (self.act[n], self.mocap[n]))
        state = State(self.joint_q[n], self.joint_qd[n], time=float(self.time[n]), act=act, mocap=mocap)
        return Sighting(state, self.command[n], bool(self.following[n]), self.task[n])

    def rows(self, number: np.ndarray) -> np.ndarray:
        """Rows of the plans with some numbers ``[...]``; -1 for those that are not here."""
        last = {int(n): row for row, n in enumerate(self.number)}  # of equal numbers the last was handed over
        return np.array([last.get(int(n), -1) for n in number.ravel()], dtype=int).reshape(number.shape)

    @classmethod
    def of(cls, about: Mapping[str, Any], lives: Sequence[np.ndarray]) -> RealTimeLog:
        """The log that rows of a :class:`~warpmpc.realtime.journal.Journal` tell.

        Args:
            about: The journal's ``about``.
            lives: Rows of each planner ``[n, width]``.
        """
        shapes = {name: tuple(shape) for name, shape in about["shapes"].items()}
        table, found, first = np.concatenate(lives), {}, 0
        for name, shape in shapes.items():
            width = int(np.prod(shape))
            values = table[:, first : first + width].reshape(len(table), *shape)
            found[name], first = values.astype(_dtype(name)), first + width
        life = np.repeat(np.arange(len(lives)), [len(rows) for rows in lives])
        return cls(origin=dict(about["origin"]), life=life, term_names=tuple(about["terms"]), **found)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All of it as arrays by names that begin with :data:`PREFIX`."""
        arrays = {field.name: np.array(getattr(self, field.name)) for field in fields(self) if field.name != "origin"}
        arrays["origin"] = np.array(json.dumps(self.origin, ensure_ascii=False))
        return {PREFIX + name: array for name, array in arrays.items()}

    @classmethod
    def from_arrays(cls, data: Mapping[str, np.ndarray]) -> RealTimeLog | None:
        """The log that :meth:`to_arrays` wrote; None where there is none.

        Raises:
            TypeError: If a part is missing.
            ValueError: If a part is something else.
        """
        found = {name.removeprefix(PREFIX): data[name] for name in data if name.startswith(PREFIX)}
        if not found:
            return None
        made = {"origin": json.loads(str(found["origin"])), "term_names": tuple(found["term_names"].tolist())}
        return cls(**{**found, **made})


def _dtype(name: str) -> type:
    if name in ("following", "survived"):
        return bool
    if name == "number":
        return int
    return float if name in TIMES else np.float32
