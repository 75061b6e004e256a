# SPDX-License-Identifier: Apache-2.0
"""The norm of a residual in a scene file: ``norm = "quadratic"``, or ``norm = { kind = "smooth_abs", p = 0.1 }``."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from ..kernels.cost import norms
from ..scene.types import Positive, Section


class NormKind(StrEnum):
    """Norms of MuJoCo MPC (Howell et al. 2022)."""

    QUADRATIC = "quadratic"
    L22 = "l22"
    L2 = "l2"
    COSH = "cosh"
    POWER = "power"
    SMOOTH_ABS = "smooth_abs"
    SMOOTH_ABS2 = "smooth_abs2"
    RECTIFY = "rectify"


_NORMS = {
    NormKind.QUADRATIC: (norms.QUADRATIC, ""),
    NormKind.L22: (norms.L22, "pq"),
    NormKind.L2: (norms.L22, "p"),
    NormKind.COSH: (norms.COSH, "p"),
    NormKind.POWER: (norms.POWER, "p"),
    NormKind.SMOOTH_ABS: (norms.SMOOTH_ABS2, "p"),
    NormKind.SMOOTH_ABS2: (norms.SMOOTH_ABS2, "pq"),
    NormKind.RECTIFY: (norms.RECTIFY, "p"),
}
"""Norm of the kernels, and the parameters that each takes."""


def _takes(kind: NormKind) -> str:
    return f"the norm {kind} takes {' and '.join(_NORMS[kind][1]) or 'neither p nor q'}"


class NormKeys(Section):
    """Norm by which a residual becomes a cost."""

    kind: NormKind
    """Which norm."""
    p: Positive | None = None
    """Where the norm bends, in the residual's unit; the exponent of ``power``."""
    q: Annotated[float, Field(strict=True, ge=1.0, allow_inf_nan=False)] | None = None
    """How sharply ``l22`` and ``smooth_abs2`` bend."""

    @model_validator(mode="after")
    def _own_parameters(self) -> NormKeys:
        wanted = _NORMS[self.kind][1]
        given = "".join(name for name in "pq" if getattr(self, name) is not None)
        if given != wanted:
            raise ValueError(_takes(self.kind))
        if self.kind is NormKind.POWER and self.p < 1.0:
            raise ValueError("the norm power takes p of 1 or more")
        return self

    def struct(self) -> norms.Norm:
        """The norm as kernels take it."""
        out = norms.Norm()
        out.kind, out.p, out.q = int(_NORMS[self.kind][0]), self.p or 1.0, self.q or 2.0
        return out


def _text_or_table(value: object) -> str:
    return "table" if isinstance(value, dict | NormKeys) else "text"


def _by_name(kind: NormKind) -> NormKeys:
    if _NORMS[kind][1]:
        raise ValueError(_takes(kind))
    return NormKeys(kind=kind)


NormKey = Annotated[
    Annotated[NormKind, AfterValidator(_by_name), Tag("text")] | Annotated[NormKeys, Tag("table")],
    Discriminator(_text_or_table),
]
"""A norm by its name, or a table."""
