# SPDX-License-Identifier: Apache-2.0
"""Residuals: a Warp function that returns one becomes a term that costs a norm of it, and its numbers one by one."""

# no postponed annotations: Warp reads those of the functions that are made here

from collections.abc import Callable
from typing import Any

import warp as wp
from pydantic import TypeAdapter, ValidationError

from ..kernels.cost.norms import L22, SQUARES, Norm, norm_part, norm_total
from ..kernels.cost.view import StepView
from .keys import TermKeys, term
from .norms import NormKey, NormKind
from .term import CostTerm, Residual, annotations, fill, params_of

_NORM = TypeAdapter(NormKey)
ROUNDED = 0.01
"""Lengths and angles, which have a kink at zero, are rounded within a centimetre or a hundredth of a radian (the L2
norm of Howell et al. 2022) where derivatives are taken."""


def fixed_norm(kind: int, p: float = 1.0) -> Norm:
    """Return a norm whose q is 2."""
    norm = Norm()
    norm.kind, norm.p, norm.q = int(kind), p, 2.0
    return norm


def rounded_length(_params: Any = None) -> Norm:
    """Return the norm √(Σ r² + p²) - p of lengths and angles."""
    return fixed_norm(L22, ROUNDED)


def cost_of(number: wp.Function, params: Any) -> wp.Function:
    """Make the cost of a residual: the norm ``p.norm`` of its ``p.numbers`` numbers.

    Args:
        number: ``(s: StepView, p: params, i: int) -> float``, number i.
        params: The ``wp.struct`` of its parameters.
    """

    @wp.func(module="unique")
    def cost(s: StepView, p: params) -> float:
        total = wp.float32(0.0)
        for i in range(p.numbers):
            total += norm_part(number(s, p, i), p.norm)
        return norm_total(total, p.norm)

    return cost


def squares_of(number: wp.Function, params: Any) -> wp.Function:
    """Make the cost of a residual that is the sum of its squares; arguments as of :func:`cost_of`."""

    @wp.func(module="unique")
    def cost(s: StepView, p: params) -> float:
        total = wp.float32(0.0)
        for i in range(p.numbers):
            r = number(s, p, i)
            total += r * r
        return total

    return cost


def entry_of(vector: wp.Function, params: Any) -> wp.Function:
    """Make number i of a function that returns a vector."""

    @wp.func(module="unique")
    def number(s: StepView, p: params, i: int) -> float:
        r = vector(s, p)
        return r[i]

    return number


def _count(p: Any) -> int:
    return p.numbers


def residual(name: str, keys: type[TermKeys]) -> Callable[[Callable], CostTerm]:
    """Turn a function ``(s, p, i) -> float``, number i of a residual, into a built-in term.

    Args:
        name: What scene files call it.
        keys: Its keys, whose ``Params`` have the fields ``numbers``, how many numbers there are, and ``norm``; without
            a norm the term is the sum of the squares.
    """

    def decorate(function: Callable) -> CostTerm:
        own, params = wp.func(function), keys.Params
        if "norm" in params.vars:
            return term(name, keys, written=own, residual=Residual(own, _count))(cost_of(own, params))
        parts = Residual(own, _count, norm=lambda p: fixed_norm(SQUARES))
        return term(name, keys, written=own, residual=parts)(squares_of(own, params))

    return decorate


def residual_term(name: str) -> Callable[[Callable], CostTerm]:
    """Turn a function that returns a residual into a cost term: a norm of the residual, which scene files choose.

    The function is as one of :func:`~warpmpc.cost_term`, but returns a float or a Warp vector of floats, as its
    annotation says, which shall be zero. Scene files set the struct's fields by name, and ``norm`` besides, which is
    quadratic when left out.

    Args:
        name: What scene files call the term.

    Raises:
        TypeError: If the function lacks its annotations, or the struct has a field ``norm``.

    Example:
        >>> @warpmpc.residual_term("lean")
        ... def lean(s: warpmpc.StepView, p: LeanParams) -> wp.vec2:
        ...     up = wp.quat_rotate(warpmpc.frame_rotation(s, p.frame), wp.vec3(0.0, 0.0, 1.0))
        ...     return wp.vec2(up[0], up[1])
    """

    def decorate(function: Callable) -> CostTerm:
        params, returned = params_of(name, function), annotations(function, returned=True).get("return")
        vector = getattr(returned, "_wp_generic_type_str_", "") == "vec_t" and returned._wp_scalar_type_ is wp.float32
        if returned is not float and not vector:
            raise TypeError(
                f"residual '{name}': write def {function.__name__}(s: warpmpc.StepView, p: {params.__name__}) -> "
                "wp.vec3, or float, or wp.types.vector(length=n, dtype=float)"
            )
        if "norm" in params.vars:
            raise TypeError(f"residual '{name}': norm is a key of every residual: name the field otherwise")
        own, normed = wp.func(function, module="unique"), _normed(params)
        size = returned._length_ if vector else None
        cost, number = _own_parts(own, normed, size)

        def bind(keys: dict[str, Any], binding: Any) -> Any:
            p = normed()
            p.norm = _norm(keys.get("norm", NormKind.QUADRATIC), binding)
            own = {key: value for key, value in keys.items() if key != "norm"}
            p.own = fill(name, params, None, own, binding, others=("norm",))
            return p

        return CostTerm(name, cost, normed, bind, written=own, residual=Residual(number, lambda p: size or 1))

    return decorate


def _norm(value: Any, binding: Any) -> Norm:
    try:
        return _NORM.validate_python(value).struct()
    except ValidationError as error:
        why = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise binding.error("wrong value", "norm", found=value, allowed=why) from None


def _normed(params: Any) -> Any:
    """Make the struct of a residual's own parameters and its norm."""

    @wp.struct
    class NormedParams:
        own: params
        norm: Norm

    return NormedParams


def _own_parts(own: wp.Function, normed: Any, size: int | None) -> tuple[wp.Function, wp.Function]:
    """Make the cost of a user's residual, a number (size None) or a vector, and number i of it."""
    count = wp.constant(size or 1)

    @wp.func(module="unique")
    def vector_cost(s: StepView, p: normed) -> float:
        r = own(s, p.own)
        total = wp.float32(0.0)
        for i in range(count):
            total += norm_part(r[i], p.norm)
        return norm_total(total, p.norm)

    @wp.func(module="unique")
    def entry(s: StepView, p: normed, i: int) -> float:
        r = own(s, p.own)
        return r[i]

    @wp.func(module="unique")
    def number_cost(s: StepView, p: normed) -> float:
        return norm_total(norm_part(own(s, p.own), p.norm), p.norm)

    @wp.func(module="unique")
    def number(s: StepView, p: normed, i: int) -> float:
        return own(s, p.own)

    return (vector_cost, entry) if size else (number_cost, number)
