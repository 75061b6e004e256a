# SPDX-License-Identifier: Apache-2.0
"""Runs a user's Warp function as Python, on arrays that watch their indices: kernels read on behind an array's end."""

from __future__ import annotations

import builtins
import copy
import dis
from types import CellType, FunctionType, ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.terms import view

if TYPE_CHECKING:
    from collections.abc import Callable

WHAT = {
    "joint_q": "joint coordinates",
    "joint_qd": "joint velocities",
    "body_q": "bodies",
    "body_qd": "bodies",
    "force": "watched contact pairs",
    "sensor": "sensor numbers",
    "controls": "controls",
    "last_control": "controls",
    "control_scale": "controls",
    "pose": "poses of the task",
    "scalar": "scalars of the task",
    "frame_body": "frames",
    "frame_pose": "frames",
    "body_com": "bodies",
    "body_mass": "bodies",
    "body_robot": "bodies",
    "memory": "numbers carried along",
}
"""Things that the last index of an array of a ``StepView`` counts."""


class OutOfRange(IndexError):
    """An index that an array has not."""


class Watched:
    """An array of a :class:`~warpmpc.StepView` that raises where a kernel would read what is not there.

    Args:
        array: The array, on any device.
        what: What its last index counts.
    """

    def __init__(self, array: wp.array, what: str):
        self._values, self._type, self._what = array.numpy(), array.dtype, what
        self._shape = array.shape

    def _at(self, index: object) -> tuple[int, ...]:
        at = tuple(int(i) for i in (index if isinstance(index, tuple) else (index,)))
        for axis, (i, size) in enumerate(zip(at, self._shape, strict=True)):
            if not 0 <= i < size:
                what = self._what if axis == len(at) - 1 else ("steps", "worlds")[min(axis, 1)]
                raise OutOfRange(
                    f"index {i} is out of range: there are {size} {what}" + f", 0 to {size - 1}" * (size > 0)
                )
        return at

    def __getitem__(self, index: object) -> Any:
        value = self._values[self._at(index)]
        return self._type(*value.tolist()) if np.ndim(value) else value.item()

    def __setitem__(self, index: object, value: object) -> None:
        self._values[self._at(index)] = value


def watched(step: view.StepView) -> SimpleNamespace:
    """A view of rollouts whose arrays watch their indices; ``t``, ``w`` and ``e`` are to be set."""
    fields = {
        name: Watched(getattr(step, name), WHAT.get(name, "steps")) for name in view.StepView.vars if len(name) > 1
    }
    return SimpleNamespace(**fields)


def as_python(function: wp.Function) -> Callable | None:
    """A Warp function as a Python function, with all that it calls; None where Python would do something else."""
    made: dict[int, Callable] = {id(view.step_before): _step_before}
    return None if _assigns_fields(function.func) else _plain(function, made)


def _assigns_fields(function: FunctionType) -> bool:
    """Return whether fields of a struct are set: in a kernel of a copy, in Python of the struct that all see."""
    return any(instruction.opname == "STORE_ATTR" for instruction in dis.get_instructions(function))


def _step_before(step: SimpleNamespace) -> SimpleNamespace:
    before = copy.copy(step)
    before.t -= 1
    return before


def _plain(value: object, made: dict[int, Callable], names: tuple[str, ...] = ()) -> object:
    """A global of a function without Warp's dispatch, which does not know watched views."""
    if id(value) in made:
        return made[id(value)]
    if isinstance(value, ModuleType):
        return SimpleNamespace(**{n: _plain(getattr(value, n), made, names) for n in names if hasattr(value, n)})
    if not isinstance(value, wp.Function) or value.func is None:
        return value
    function, names = value.func, value.func.__code__.co_names
    cells = tuple(CellType(_plain(cell.cell_contents, made, names)) for cell in function.__closure__ or ())
    scope: dict[str, object] = {"__builtins__": builtins}
    made[id(value)] = FunctionType(function.__code__, scope, value.key, function.__defaults__, cells or None)
    scope |= {n: _plain(function.__globals__[n], made, names) for n in names if n in function.__globals__}
    return made[id(value)]
