# SPDX-License-Identifier: Apache-2.0
"""Parts that these terms share: variables that later statements change."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ...cost.code.state import TermCode


def variable(code: TermCode, name: str, value: str) -> str:
    """Define a variable of a term; returns its name, which no other term has."""
    name = f"{name}_{code.params.replace('.', '_')}"
    code.lines.add(f"T {name} = {value};")
    return name
