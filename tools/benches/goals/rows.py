# SPDX-License-Identifier: Apache-2.0
"""Rows of the table of goals: what is timed, where, and how fast it shall be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass

PLAN, CORE, WARP = "plan", "core", "warp"
"""Kinds of rows: a whole plan [ms], physics on one core against ``mujoco.rollout`` and physics on a GPU against MuJoCo
Warp [times]."""
MOST_WORLDS = 8192
"""Worlds of a row of the kind :data:`WARP`."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Something to measure."""

    kind: str
    scene: str
    """Scene, or model of tools/shared/models.py."""
    goal: float | None
    """Largest time of a plan [ms], or least ratio of times; None where there is none."""
    overrides: tuple[str, ...] = ()
    """Changes of the scene, ``KEY=VALUE``."""
    envs: int = 1
    cores: int | None = None
    """Cores of the CPU that may be used, None on a GPU."""

    @property
    def where(self) -> str:
        """What it runs on, for people."""
        return "the GPU" if self.cores is None else f"{self.cores} core{'s' if self.cores > 1 else ''}"

    @property
    def title(self) -> str:
        """What is measured, for people."""
        if self.kind == CORE:
            return f"{self.scene}: physics against mujoco.rollout"
        if self.kind == WARP:
            return f"{self.scene}: physics of {MOST_WORLDS} worlds against MuJoCo Warp"
        values = dict(text.split("=", 1) for text in self.overrides)
        keys = ("planner.samples", "planner.horizon", "engine.substeps")
        sizes = " × ".join(values[key] for key in keys if key in values)
        return f"{self.scene} {sizes}" + (f", {self.envs} environments" if self.envs > 1 else "")

    def to_json(self) -> dict:
        """The row as data for JSON."""
        return asdict(self) | {"title": self.title, "where": self.where}


def _sizes(samples: int, horizon: int, substeps: int | None = None, dt: float | None = None) -> tuple[str, ...]:
    out = [f"planner.samples={samples}", f"planner.horizon={horizon}", "planner.iterations=1"]
    out += [] if substeps is None else [f"engine.substeps={substeps}"]
    return (*out, *([] if dt is None else [f"planner.dt={dt}"]))


_SINGLE = _sizes(500, 8, 1, 0.04)
PLANS = (
    # scene, overrides, environments, goal on the GPU, goals by cores of the CPU [ms]
    ("omni_push_box", _sizes(64, 12, 4), 1, 1.6, {2: 2.0}),
    ("omni_push_box", _sizes(500, 12, 4), 1, None, {16: 2.5}),
    ("omni_push_box", _SINGLE, 1, 0.5, {}),
    ("omni_push_box", _SINGLE, 64, 2.5, {}),
    ("panda_push_objects", _sizes(512, 12, 4), 1, 6.0, {2: 25.0}),
    ("panda_push_objects", _sizes(64, 12, 4), 1, None, {2: 4.0}),
    ("mobile_pick", _sizes(750, 8, 3), 1, 3.5, {2: 25.0}),
    ("mobile_pick", _sizes(128, 8, 3), 1, None, {2: 5.0}),
    ("panda_reach", _sizes(500, 12, 2, 0.06), 1, 2.0, {2: 8.0}),
    ("push_t", _sizes(2048, 50, 1, 0.01), 1, 4.0, {}),
    ("cylinder_push", _sizes(256, 50, dt=0.02), 1, None, {2: 4.0}),
    ("humanoid_stand", _sizes(512, 40), 1, 4.0, {2: 26.0}),
    ("humanoid_stand", _sizes(16, 40), 1, None, {2: 1.2}),
)
RATIOS = {"quadruped": 15.0, "humanoid": 8.0, "arm_with_box": 8.0, "hand": 5.0}
"""Model → least ratio of times on one core."""
WARP_RATIOS = {"arm_with_box": 2.5, "quadruped": 2.5, "humanoid": 2.5}
"""Model → least ratio of times on a GPU."""


def rows_here(machine: dict, on: str = "all", *, pretend: bool = False) -> list[Row]:
    """Rows that can be measured on a machine: the GPU's first, then by cores.

    Args:
        machine: What :func:`shared.machine.machine` says of it.
        on: ``gpu``, ``cpu`` or ``all``.
        pretend: Whether rows of a GPU are run without one, too, on the CPU: with tiny sizes, to see that they run.
    """
    gpu, cores = bool(machine["gpus"]) or pretend, machine["cores"]
    rows = [
        row for row in _rows() if (gpu and on != "cpu" if row.cores is None else row.cores <= cores and on != "gpu")
    ]
    order = {None: 0, 2: 1, 16: 2, 1: 3}
    return sorted(rows, key=lambda row: (order[row.cores], row.kind != PLAN))


def _rows() -> Iterator[Row]:
    for scene, overrides, envs, gpu, by_cores in PLANS:
        common = {"kind": PLAN, "scene": scene, "overrides": overrides, "envs": envs}
        if gpu is not None:
            yield Row(goal=gpu, **common)
        for cores, goal in by_cores.items():
            yield Row(goal=goal, cores=cores, **common)
    for model, least in RATIOS.items():
        yield Row(kind=CORE, scene=model, goal=least, cores=1)
    for model, least in WARP_RATIOS.items():
        yield Row(kind=WARP, scene=model, goal=least)
