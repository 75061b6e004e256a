# SPDX-License-Identifier: Apache-2.0
"""What the agent did at each tick of a run in real time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

import numpy as np

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

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All of it as arrays by names that begin with :data:`PREFIX`."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
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
