# SPDX-License-Identifier: Apache-2.0
"""Targets of a residual's numbers: numbers of the scene file, or scalars of the task."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..kernels.terms.residuals import Wanted
from ..scene.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .binding import Binding


def wanted(target: Sequence[float | str] | None, count: int, b: Binding, *, key: str = "target") -> Wanted:
    """Targets of each of a residual's numbers.

    Args:
        target: Numbers or names of scalars, one or one for each; zeros when None.
        count: How many numbers the residual has.
        b: The term that is being bound.
        key: What the scene file calls it, for errors.

    Raises:
        SceneError: If there are neither one nor as many as numbers, or a scalar does not exist.
    """
    target = (0.0,) if target is None else target
    if len(target) not in (1, count):
        raise SceneError(f"needs 1 or {count} values", key=f"{b.key}.{key}", file=b.file, found=list(target))
    if len(target) < count:
        target = target * count
    out = Wanted()
    scalars = [b.scalar(value, key) if isinstance(value, str) else -1 for value in target]
    out.scalar = b.array(scalars, dtype=int)
    out.value = b.array([0.0 if isinstance(value, str) else value for value in target], dtype=float)
    return out
