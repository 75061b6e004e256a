# SPDX-License-Identifier: Apache-2.0
"""What the agent did at each tick of a run in real time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

import numpy as np

from ..model.state import State
from ..realtime.agent import Fault
from ..realtime.watchdog import FaultKind

PREFIX = "tick_"
"""How names of a log's arrays begin in a file."""


@dataclass(frozen=True, kw_only=True)
class TickLog:
    """What the agent did at each of N ticks, and the plans that it had."""

    plan: np.ndarray
    """Number of the newest plan ``[N]``, -1 before the first."""
    following: np.ndarray
    """Whether the command came from it, and not from the watchdog ``[N]``."""
    late_ms: np.ndarray
    """How late the tick was, in wall time ``[N]`` [ms]."""
    age: np.ndarray
    """Time since the observation that the newest plan was made from ``[N]`` [s]; NaN without a plan."""
    faults: tuple[Fault, ...]
    """Times in which no plan was followed."""
    now: np.ndarray | None = None
    """The robot's clock ``[N]`` [s]; None, as all that follows, in files of older versions."""
    seen_time: np.ndarray | None = None
    """Time of the observation ``[N]`` [s]."""
    seen_q: np.ndarray | None = None
    """Observed joint coordinates ``[N, nq]``, NaN where there were more or fewer of them, like all that follows."""
    seen_qd: np.ndarray | None = None
    """Observed joint velocities ``[N, nv]``."""
    seen_act: np.ndarray | None = None
    """Observed activations ``[N, na]``."""
    seen_mocap: np.ndarray | None = None
    """Observed poses of mocap bodies ``[N, nm, 7]``."""

    def state(self, n: int) -> State:
        """The observation of tick n."""
        return State(
            self.seen_q[n],
            self.seen_qd[n],
            time=float(self.seen_time[n]),
            act=self.seen_act[n],
            mocap=self.seen_mocap[n],
        )

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All of it as arrays by names that begin with :data:`PREFIX`."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays = {name: array for name, array in arrays.items() if array is not None}
        arrays["faults"] = np.array(json.dumps([asdict(fault) for fault in self.faults]))
        return {PREFIX + name: array for name, array in arrays.items()}

    @classmethod
    def from_arrays(cls, data: Mapping[str, np.ndarray]) -> TickLog | None:
        """The log that :meth:`to_arrays` wrote; None where there is none."""
        found = {name.removeprefix(PREFIX): data[name] for name in data if name.startswith(PREFIX)}
        if not found:
            return None
        faults = [Fault(**{**fault, "kind": FaultKind(fault["kind"])}) for fault in json.loads(str(found["faults"]))]
        return cls(**{**found, "faults": tuple(faults)})
