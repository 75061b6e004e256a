# SPDX-License-Identifier: Apache-2.0
"""Cost terms: what a scene file names, what a user writes, and the kernel that evaluates one over all rollouts."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from pydantic import ValidationError

from ..kernels.cost.norms import Norm
from ..kernels.cost.view import StepView
from ..scene.schema import Cost
from ..scene.task.task import AncillaryController
from ..scene.types import described

if TYPE_CHECKING:
    from ..physics.runtime.bake import Operand
    from ..scene.types import Section
    from .binding import Binding
    from .code.state import TermCode


@dataclass(frozen=True)
class Residual:
    """The numbers that a term is a norm of, for planners with derivatives.

    ``kernels.cost.norms`` has the norm's value, gradient and Hessian.
    """

    component: wp.Function
    """``(s: StepView, p: Params, i: int) -> float``: number i."""
    dimension: Callable[[Any], int]
    """How many they are, given the filled parameter struct; none where these parameters make the term no norm."""
    norm: Callable[[Any], Norm] = attrgetter("norm")
    """The norm, given the filled parameter struct."""


@dataclass(frozen=True)
class CostTerm:
    """A cost term: a Warp function of one step of one world and its parameters.

    Build one with :func:`cost_term` and hand it to :class:`warpmpc.Controller` and :class:`warpmpc.Plant`.
    """

    name: str
    function: wp.Function
    """``(s: StepView, p: Params) -> float``."""
    params: Any
    """The ``wp.struct`` of its parameters, or None."""
    bind: Callable[[dict[str, Any], Binding], Any]
    """Turns the keys of a scene file into a filled parameter struct."""
    keys: type[Section] | None = None
    """Types of those keys, for help texts and errors; derived from the struct for users' terms."""
    source: Callable[[TermCode, Any], Operand | None] | None = None
    """Writes the term's source by hand, given its filled parameter struct; returns the value, or None where the
    parameters ask for what only :attr:`function` can do. A launch prefers it to the traced source."""
    advance: wp.Function | None = None
    """``(s: StepView, p: Params)``, called at the steps 0, 1, ... of every rollout before any is evaluated: writes
    the numbers that the term carries along (:func:`~warpmpc.remember`), from the step before and what else it sees."""
    residual: Residual | None = None
    """Residual that the term is a norm of, if it is one."""
    written: wp.Function | None = None
    """Function as it is written, where :attr:`function` is made of it."""

    @property
    def summary(self) -> str:
        """Summary of its cost: the first of the function's docstring."""
        return _summary((self.written or self.function).func)


@dataclass(frozen=True)
class ArrayCost:
    """A cost term over whole batches of arrays, for quick experiments; build one with :func:`array_cost`."""

    name: str
    function: Callable[[dict[str, Any]], Any]

    @property
    def summary(self) -> str:
        """Summary of its cost: the first of the function's docstring."""
        return _summary(self.function)

    def bind(self, values: dict[str, Any], binding: Binding) -> dict[str, Any]:
        """The keys as they are, which the function reads, or one that it calls.

        Raises:
            SceneError: If none does, and the key is nearly one that every cost has.
        """
        with suppress(OSError, TypeError, AttributeError):  # without its source its keys are unknown
            called = map(self.function.__globals__.get, self.function.__code__.co_names)
            source = "".join(inspect.getsource(f) for f in (self.function, *called) if inspect.isfunction(f))
            for key in values:
                if key not in source and difflib.get_close_matches(key, Cost.model_fields, cutoff=0.8):
                    raise binding.unknown(key, {})
        return dict(values)


def _summary(function: Callable) -> str:
    return (inspect.getdoc(function) or "").split("\n\n")[0].replace("\n", " ")


UserTerm = CostTerm | ArrayCost | AncillaryController
"""Term or ancillary controller that a user brings along with a scene."""


def cost_term(name: str, *, advance: Callable | None = None, numbers: int = 0) -> Callable[[Callable], CostTerm]:
    """Turn a function of one step into a cost term.

    The function takes a :class:`~warpmpc.StepView` and a ``wp.struct`` of parameters and returns a float. Scene
    files set the struct's fields by name; a string given for an ``int`` field is looked up as a frame
    (``robot/frame``), as a joint when the field's name contains ``joint``, as the first number of a sensor
    (``robot/sensor``) when it contains ``sensor``, as a scalar of the task when it contains ``scalar``, as the first
    number that another term carries along when it contains ``memory``, and as a robot or an object when it ends with
    ``robot``.

    Args:
        name: What scene files call the term.
        advance: Dynamics of the term's own: a function of the same two arguments that writes its numbers at the steps
            0, 1, ... of every rollout, before any of them is evaluated. The numbers begin at the field ``memory``
            of the struct, which is set for it.
        numbers: How many numbers that are.

    Raises:
        TypeError: If a function lacks the annotations ``StepView`` and a ``wp.struct``, or the struct the field
            ``memory`` for its numbers.

    Example:
        >>> @wp.struct
        ... class UprightParams:
        ...     frame: int
        >>> @warpmpc.cost_term("upright")
        ... def upright(s: warpmpc.StepView, p: UprightParams) -> float:
        ...     return 1.0 - wp.quat_rotate(warpmpc.frame_rotation(s, p.frame), wp.vec3(0.0, 0.0, 1.0))[2]
    """
    if not isinstance(name, str) or not name:
        raise TypeError(f'a cost term has a name, not {name!r}: @warpmpc.cost_term("name")')

    def decorate(function: Callable) -> CostTerm:
        params = params_of(name, function)
        bind = partial(fill, name, params, numbers if advance else None)
        if advance is None:
            return CostTerm(name, wp.func(function, module="unique"), params, bind)
        if list(annotations(advance).values()) != [StepView, params] or "memory" not in params.vars or numbers < 1:
            raise TypeError(
                f"cost term '{name}': what it carries along needs numbers = 1 or more, def {advance.__name__}(s: "
                f"warpmpc.StepView, p: {params.__name__}) and a field memory: int in that struct"
            )
        made = (wp.func(f, module="unique") for f in (function, advance))
        return CostTerm(name, next(made), params, bind, advance=next(made))

    return decorate


def array_cost(name: str) -> Callable[[Callable], ArrayCost]:
    """Turn a function over whole batches into a cost term: slower, outside the kernels, no Warp needed.

    The function receives a dict of arrays (NumPy on the CPU, DLPack-compatible Warp arrays on CUDA):
    ``joint_q [T+1, W, nq]``, ``joint_qd [T+1, W, nv]``, ``body_q [T+1, W, nb, 7]``, ``body_qd [T+1, W, nb, 6]``,
    ``contact_force [T, W, pair, 3]``, ``sensor [T, W, ns]``, ``control [T, W, nu]``, ``goal [E, 7]``, all poses of the
    task ``pose [E, poses, 7]`` and its scalars ``scalar [E, scalars]``; and the keys of its ``[[cost]]`` table under
    ``params``. It returns the cost of every step and world, ``[T, W]``.

    Args:
        name: What scene files call the term.
    """
    if not isinstance(name, str) or not name:
        raise TypeError(f'a cost term has a name, not {name!r}: @warpmpc.array_cost("name")')
    return lambda function: ArrayCost(name, function)


def params_of(name: str, function: Callable) -> Any:
    """The ``wp.struct`` that a user's function of a step takes.

    Raises:
        TypeError: If it lacks the annotations ``StepView`` and a ``wp.struct``.
    """
    kinds = list(annotations(function).values())
    if len(kinds) < 2 or kinds[0] is not StepView or not hasattr(kinds[1], "vars"):
        raise TypeError(
            f"cost term '{name}': write def {function.__name__}(s: warpmpc.StepView, p: Params) -> float, "
            "with Params a wp.struct"
        )
    return kinds[1]


def annotations(function: Callable, *, returned: bool = False) -> dict[str, Any]:
    """Annotations resolved against the function's globals and closure, so that postponed ones work too.

    Args:
        function: The function.
        returned: Whether that of what it returns is wanted, too.
    """
    cells = dict(zip(function.__code__.co_freevars, [c.cell_contents for c in function.__closure__ or ()], strict=True))
    return {
        k: eval(v, {**function.__globals__, **cells}) if isinstance(v, str) else v  # the user's own annotation
        for k, v in function.__annotations__.items()
        if returned or k != "return"
    }


def fill(
    name: str, params: Any, numbers: int | None, keys: dict[str, Any], binding: Binding, *, others: tuple[str, ...] = ()
) -> Any:
    """Fill a user's parameter struct from scene keys.

    ``numbers`` is how many the term carries along itself, ``others`` are keys that it has besides.
    """
    struct = params()
    if numbers is not None:
        keys = {**keys, "memory": binding.carry(numbers)}
    finders = {
        "joint": binding.joint,
        "robot": binding.robot,
        "sensor": binding.sensor,
        "scalar": binding.scalar,
        "memory": binding.carried,
    }
    for key, value in keys.items():
        if key not in params.vars:
            raise binding.unknown(key, dict.fromkeys((*params.vars, *others)))
        if isinstance(value, str):
            find = next((look for word, look in finders.items() if word in key), binding.frame)
            value = find(value, key)
        try:
            finite = not isinstance(value, bool) and bool(np.all(np.isfinite(np.asarray(value, dtype=float))))
        except (TypeError, ValueError):
            finite = False
        if not finite:
            raise binding.error("needs finite numbers", key, found=value)
        try:
            setattr(struct, key, params.vars[key].type(*value) if isinstance(value, list | tuple) else value)
        except (TypeError, ValueError, RuntimeError) as error:
            raise binding.error(f"does not fit its field: {error}", key, found=value) from error
    missing = [field for field in params.vars if field not in keys]
    if missing:
        raise binding.error(f"cost term '{name}' needs the key '{missing[0]}'")
    return struct


def parse_keys(keys: type[Section], values: dict[str, Any], binding: Binding) -> Section:
    """Validate a built-in term's keys.

    Raises:
        SceneError: If a key is unknown, missing or of the wrong type.
    """
    try:
        return keys.model_validate(values)
    except ValidationError as error:
        # an unknown key is often a missing one misspelt
        first = min(error.errors(), key=lambda detail: detail["type"] != "extra_forbidden")
        # a name, and which entry of its list; what follows are names of types
        name = ".".join(str(part) for part in first["loc"][:1] + first["loc"][1:2] * isinstance(first["loc"][-1], int))
        if first["type"] == "extra_forbidden" and len(first["loc"]) == 1:
            raise binding.unknown(name, {key: field.description for key, field in described(keys).items()}) from None
        if first["type"] == "missing" and len(first["loc"]) == 1:
            raise binding.error(f"the key '{name}' is missing") from None
        field = described(keys).get(str(first["loc"][0]))
        allowed = field.description if field and field.description else first["msg"]
        if first["type"] == "value_error":  # says itself what is wrong
            allowed = first["msg"].removeprefix("Value error, ")
        raise binding.error("wrong value", name, found=first["input"], allowed=str(allowed)) from None
