# SPDX-License-Identifier: Apache-2.0
"""MuJoCo's step of many worlds as source written for one model, a world in each lane of a register.

``model`` reads a compiled MuJoCo model, ``tree``, ``dynamics`` and ``factor`` write what does not branch, ``native``
holds what loops over tables (collisions, constraint rows, the solver), ``source`` puts them together, ``kernel``
compiles them, ``rollout`` runs them. Nothing here knows of scenes, costs or layouts.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from . import rollout
    from .linearization import linearize
    from .mujoco_batch import Batch
    from .simulator import BatchSimulator

__all__ = ["Batch", "BatchSimulator", "linearize", "rollout"]


def __getattr__(name: str) -> object:
    """Import a public name when it is first used: ``runtime`` is asked for without the rest."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = {"Batch": "mujoco_batch", "BatchSimulator": "simulator", "linearize": "linearization"}.get(name)
    value = importlib.import_module(f".{home or name}", __name__)
    globals()[name] = getattr(value, name) if home else value
    return globals()[name]
