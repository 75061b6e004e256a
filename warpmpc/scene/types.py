# SPDX-License-Identifier: Apache-2.0
"""Number and vector types of scene files: every float is finite, every length is checked."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


def _as_tuple(value: object) -> object:
    """Accept a scalar where a list is meant, so that ``limit = 1.5`` reads as ``limit = [1.5]``."""
    return (value,) if isinstance(value, int | float) and not isinstance(value, bool) else value


def _as_list(value: object) -> object:
    """Accept one table where an array of tables is meant."""
    return (value,) if isinstance(value, dict | BaseModel) else value


Finite = Annotated[float, Field(allow_inf_nan=False, strict=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0.0, lt=1.0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_\-]*$")]
Vec3 = tuple[Finite, Finite, Finite]
Quat = tuple[Finite, Finite, Finite, Finite]
Floats = Annotated[tuple[Finite, ...], BeforeValidator(_as_tuple)]
Positives = Annotated[tuple[Positive, ...], BeforeValidator(_as_tuple)]
NonNegatives = Annotated[tuple[NonNegative, ...], BeforeValidator(_as_tuple)]
OneOrMore = BeforeValidator(_as_list)


class Section(BaseModel):
    """A frozen table of a scene file: unknown keys are errors, numbers are never read from strings."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, validate_default=True)
