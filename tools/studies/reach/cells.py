# SPDX-License-Identifier: Apache-2.0
"""What is compared: methods, and the planner with one thing changed at a time."""

from __future__ import annotations

from dataclasses import dataclass

METHODS = ("planner", "least")


@dataclass(frozen=True)
class Cell:
    """One row of a table."""

    name: str
    overrides: tuple[str, ...] = ()
    """Changes of the scene, ``KEY=VALUE``."""
    method: str = "planner"


def _adapted(form: str) -> Cell:
    """STORM's α_σ and κ."""
    keys = {"form": f'"{form}"', "step_size": "0.7", "kappa": "0.005"}
    return Cell(f"covariance {form}", tuple(f"planner.covariance.{key}={value}" for key, value in keys.items()))


TERMS = ("pose", "stop", "manipulability", "joint_bounds", "posture", "self_collision", "world_collision")

ABLATIONS = (
    Cell("as shipped"),
    Cell("without postures", ("planner.postures=false",)),
    *(Cell(f"without {term}", (f"cost.{term}.weight=0.0",)) for term in TERMS),
    *map(_adapted, ("sigma", "diagonal", "full")),
    Cell("no null particles", ("planner.noise.null_sample=false",)),
    Cell("5 % null particles", ("planner.noise.null_share=0.05",)),
    Cell("the same noise at every plan", ("planner.noise.redraw=false",)),
    *(Cell(f"N = {count}", (f"planner.samples={count}",)) for count in (50, 100, 200, 1000, 5000)),
    *(
        Cell(f"N = {count}, no postures", (f"planner.samples={count}", "planner.postures=false"))
        for count in (50, 5000)
    ),
)
"""The paper's ablations."""
