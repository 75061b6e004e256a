# SPDX-License-Identifier: Apache-2.0
"""Users' residuals: a Warp function that returns a residual becomes a term that costs a norm of it."""

# no postponed annotations: Warp reads those of the functions that are made here

from collections.abc import Callable
from typing import Any

import warp as wp
from pydantic import TypeAdapter, ValidationError

from ..kernels.terms.norms import Norm, norm_part, norm_total
from ..kernels.terms.view import StepView
from ..scene.errors import SceneError
from .norms import NormKey, NormKind
from .term import CostTerm, Residual, annotations, fill, params_of

_NORM = TypeAdapter(NormKey)


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
        size = returned._length_ if vector else 1
        if returned is not float and not vector:
            raise TypeError(
                f"residual '{name}': write def {function.__name__}(s: warpmpc.StepView, p: {params.__name__}) -> "
                "wp.vec3, or float, or wp.types.vector(length=n, dtype=float)"
            )
        if "norm" in params.vars:
            raise TypeError(f"residual '{name}': norm is a key of every residual: name the field otherwise")
        own = wp.func(function, module="unique")
        normed = _normed(params)
        cost, component = (_of_number if returned is float else _of_vector)(own, normed, size)

        def bind(keys: dict[str, Any], binding: Any) -> Any:
            p = normed()
            p.norm = _norm(keys.get("norm", NormKind.QUADRATIC), binding)
            p.own = fill(name, params, None, {key: value for key, value in keys.items() if key != "norm"}, binding)
            return p

        return CostTerm(name, cost, normed, bind, written=own, residual=Residual(component, lambda p: size))

    return decorate


def _norm(value: Any, binding: Any) -> Norm:
    try:
        return _NORM.validate_python(value).struct()
    except ValidationError as error:
        why = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise SceneError(
            "wrong value", key=f"{binding.key}.norm", file=binding.file, found=value, allowed=why
        ) from None


def _normed(params: Any) -> Any:
    """The struct of a residual's own parameters and its norm."""

    @wp.struct
    class NormedParams:
        own: params
        norm: Norm

    return NormedParams


def _of_number(own: wp.Function, normed: Any, size: int) -> tuple[wp.Function, wp.Function]:
    """The cost of a residual that is one number, and that number."""

    @wp.func(module="unique")
    def number_cost(s: StepView, p: normed) -> float:
        """Norm of a residual of the user's."""
        return norm_total(norm_part(own(s, p.own), p.norm), p.norm)

    @wp.func(module="unique")
    def number_component(s: StepView, p: normed, i: int) -> float:
        """The residual."""
        return own(s, p.own)

    return number_cost, number_component


def _of_vector(own: wp.Function, normed: Any, size: int) -> tuple[wp.Function, wp.Function]:
    """The cost of a residual that is a vector, and its numbers one by one."""
    count = wp.constant(size)

    @wp.func(module="unique")
    def vector_cost(s: StepView, p: normed) -> float:
        """Norm of a residual of the user's."""
        r = own(s, p.own)
        total = wp.float32(0.0)
        for i in range(count):
            total += norm_part(r[i], p.norm)
        return norm_total(total, p.norm)

    @wp.func(module="unique")
    def vector_component(s: StepView, p: normed, i: int) -> float:
        """Number i of the residual."""
        r = own(s, p.own)
        return r[i]

    return vector_cost, vector_component
