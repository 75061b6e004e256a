# SPDX-License-Identifier: Apache-2.0
"""MuJoCo's step of many worlds as source written for one model, a world in each lane of a register.

``model`` reads a compiled MuJoCo model, ``tree``, ``dynamics`` and ``factor`` write what does not branch, ``native``
holds what loops over tables (collisions, constraint rows, the solver), ``source`` puts them together, ``kernel``
compiles them, ``rollout`` runs them. Nothing here knows of scenes, costs or layouts.
"""

from . import rollout
from .mujoco_batch import Batch
from .simulator import BatchSimulator

__all__ = ["Batch", "BatchSimulator", "rollout"]
