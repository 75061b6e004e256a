# SPDX-License-Identifier: Apache-2.0
"""Overrides whose ``*`` skips entries without the key."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warpmpc.scene.overrides import parse_override
from warpmpc.tuning.space import present

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warpmpc import Scene


def spread(scene: Scene, overrides: Sequence[str]) -> tuple[str, ...]:
    """Overrides whose ``*`` stands only for entries that have the key, so that ``cost.*.metric`` skips other terms.

    Raises:
        ValueError: If no entry has the key.
        SceneError: If a key or value cannot be read.
    """
    out = []
    for text in overrides:
        key, _ = parse_override(text)
        if "*" not in key:
            out.append(text)
            continue
        name, _, value = text.partition("=")
        if not (keys := present(scene, name)):
            raise ValueError(f"--set {text}: no entry of {scene.name} has this key")
        out += [f"{full}={value}" for full in keys]
    return tuple(out)
