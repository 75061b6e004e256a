# SPDX-License-Identifier: Apache-2.0
"""Number and vector types of scene files: every float is finite, every length is checked."""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from functools import cache
from itertools import pairwise
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, model_validator

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo


def _as_tuple(value: object) -> object:
    """Accept a scalar where a list is meant, so that ``limit = 1.5`` reads as ``limit = [1.5]``."""
    return (value,) if isinstance(value, int | float) and not isinstance(value, bool) else value


def _as_names(value: object) -> object:
    """Accept one name where a list of them is meant."""
    return (value,) if isinstance(value, str) else value


def _as_list(value: object) -> object:
    """Accept one table where an array of tables is meant."""
    return (value,) if isinstance(value, dict | BaseModel) else value


def _as_several(value: object) -> object:
    """Accept one of anything where several may be meant."""
    return value if isinstance(value, list | tuple) else (value,)


def _list_or_table(value: object) -> str:
    return "table" if isinstance(value, dict) else "list"


def _number_or_list(value: object) -> str:
    return "list" if isinstance(value, list | tuple) else "number"


def _unit(q: tuple[float, ...]) -> tuple[float, ...]:
    """Normalize a quaternion; one that is already a unit stays as it is, to the last bit."""
    norm = math.hypot(*q)
    if norm < 1e-6 or not math.isfinite(norm):
        raise ValueError("a rotation is a quaternion (x, y, z, w) of length above zero")
    return q if abs(norm - 1.0) < 1e-12 else tuple(c / norm for c in q)


def _single(value: float) -> float:
    """Accept what single precision holds, and products with other numbers of a scene with it."""
    if abs(value) > LARGEST:
        raise ValueError(f"must fit into single precision: at most {LARGEST:g}")
    return value


def _plain(value: object) -> object:
    """Accept what a file can say (numbers, text, true, false, lists, tables), every number finite."""
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError("must be finite")
        _single(value)
    elif isinstance(value, list | tuple):
        for item in value:
            _plain(item)
    elif isinstance(value, dict):
        for item in value.values():
            _plain(item)
    elif not isinstance(value, str | int | None):
        raise ValueError(f"must be a number, text, true, false, a list or a table, not {type(value).__name__}")
    return value


LARGEST = 1e30
"""Largest size of a number: single precision ends at 3.4e38, and sums of many must fit, too."""
Single = AfterValidator(_single)
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False), Single]
Positive = Annotated[float, Field(strict=True, gt=0.0, allow_inf_nan=False), Single]
NonNegative = Annotated[float, Field(strict=True, ge=0.0, allow_inf_nan=False), Single, AfterValidator(abs)]  # -0 is 0
Fraction = Annotated[float, Field(strict=True, ge=0.0, lt=1.0, allow_inf_nan=False)]
Share = Annotated[float, Field(strict=True, gt=0.0, le=1.0, allow_inf_nan=False)]
Channel = Annotated[float, Field(strict=True, ge=0.0, le=1.0, allow_inf_nan=False)]
Natural = Annotated[int, Field(strict=True, ge=0, le=2**31 - 1)]
Count = Annotated[int, Field(strict=True, ge=1, le=2**31 - 1)]
TwoOrMore = Annotated[int, Field(strict=True, ge=2, le=2**31 - 1)]
Flag = Annotated[bool, Field(strict=True)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_\-]*$")]
Vec3 = tuple[Finite, Finite, Finite]
Vec2or3 = Annotated[tuple[Finite, ...], Field(min_length=2, max_length=3)]
Quat = Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(_unit)]
Floats = Annotated[tuple[Finite, ...], Field(min_length=1), BeforeValidator(_as_tuple)]
Positives = Annotated[tuple[Positive, ...], Field(min_length=1), BeforeValidator(_as_tuple)]
NonNegatives = Annotated[tuple[NonNegative, ...], Field(min_length=1), BeforeValidator(_as_tuple)]
Fractions = Annotated[tuple[Fraction, ...], Field(min_length=1), BeforeValidator(_as_tuple)]
FloatOrFloats = Annotated[
    Annotated[Finite, Tag("number")] | Annotated[tuple[Finite, ...], Tag("list")], Discriminator(_number_or_list)
]
FloatsByName = Annotated[
    Annotated[Floats, Tag("list")] | Annotated[dict[str, FloatOrFloats], Tag("table")], Discriminator(_list_or_table)
]
Param = Annotated[Any, AfterValidator(_plain)]
OneOrMore = BeforeValidator(_as_list)
OneOrSeveral = BeforeValidator(_as_several)
Names = Annotated[tuple[str, ...], Field(min_length=1), BeforeValidator(_as_names)]

ONE_FOR_LIST = (_as_tuple, _as_names, _as_list, _as_several)
"""Validators that let a file say one entry where a list is meant."""


class Section(BaseModel):
    """A frozen table of a scene file: unknown keys are errors, numbers are never read from strings.

    ``false`` switches off a key that may be absent: ``ground = false``, ``planner.temperature.eta = false``. A flag
    that may be left out keeps it: false is what it says, and not that it says nothing.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _switched_off(cls, data: object) -> object:
        if not isinstance(data, dict) or not any(value is False for value in data.values()):
            return data
        return {key: None if value is False and cls._may_be_absent(key) else value for key, value in data.items()}

    @classmethod
    def _may_be_absent(cls, key: str) -> bool:
        field = cls.model_fields.get(key)
        kinds = get_args(field.annotation) if field is not None else ()
        return NoneType in kinds and not any(bool in (kind, *get_args(kind)) for kind in kinds)


@cache
def described(section: type[BaseModel]) -> dict[str, FieldInfo]:
    """Keys of a section, each with the docstring below it as its description.

    Reading those from the source takes longer than all else of a section, and few programs ask.
    """
    said: dict[str, str] = {}
    for kind in reversed(section.__mro__):
        if issubclass(kind, BaseModel) and kind is not BaseModel:
            said |= _docstrings(kind)
    for name, field in section.model_fields.items():
        field.description = field.description or said.get(name)
    return section.model_fields


def _docstrings(kind: type) -> dict[str, str]:
    """Strings that stand below the annotated names of a class."""
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body
    except (OSError, TypeError, SyntaxError):  # made without a file, or of one that was changed since
        return {}
    return {
        first.target.id: inspect.cleandoc(second.value.value)
        for first, second in pairwise(body)
        if isinstance(first, ast.AnnAssign)
        and isinstance(second, ast.Expr)
        and isinstance(second.value, ast.Constant)
        and isinstance(second.value.value, str)
    }
