# SPDX-License-Identifier: Apache-2.0
"""Built-in cost terms by name, found in the room :mod:`warpmpc.terms`, which is above this one."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .term import CostTerm

BUILTIN: dict[str, CostTerm] = import_module("warpmpc.terms").TERMS
"""Built-in terms by name."""
