# SPDX-License-Identifier: Apache-2.0
"""The form of a finding."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A likely mistake."""

    key: str
    """Key of the scene, or the asset, that it is in."""
    text: str
    """The mistake and its effect, in one sentence."""
    cure: str
    """Change that mends it."""

    def __str__(self) -> str:
        return f"{self.key}: {self.text}; {self.cure}"
