# SPDX-License-Identifier: Apache-2.0
"""Built-in cost terms by family: each term's keys, what they bind, and its Warp function of one step."""

from ..term import CostTerm
from . import (
    arm,
    clearance,
    cloud,
    collision,
    general,
    grasping,
    joints,
    learned,
    learned_cloud,
    numbers,
    pushing,
    residuals,
    rolling,
)

_FAMILIES = (
    general,
    joints,
    pushing,
    clearance,
    grasping,
    arm,
    collision,
    rolling,
    cloud,
    learned,
    learned_cloud,
    residuals,
    numbers,
)
TERMS = {term.name: term for family in _FAMILIES for term in vars(family).values() if isinstance(term, CostTerm)}
"""Built-in terms by name."""
