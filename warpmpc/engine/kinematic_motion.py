# SPDX-License-Identifier: Apache-2.0
"""Source of the joints' motion under their drives (Bhardwaj et al. 2021, Eq. 7).

Step after step on a CPU, by scans over the lanes of a warp on a GPU, where every lane has a step.
Names as in :mod:`.state`; ``live`` says whether there is such a step, ``q_in``, ``v_in``, ``a_in`` and ``c_in`` carry
states and controls from one block of lanes to the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..bake.lines import Lines, text

WARP = 32
"""Lanes of a warp."""
_UP = "__shfl_up_sync(0xffffffffu, {0}, {1})"
_SCAN = f"for (int m = 1; m < {WARP}; m <<= 1) {{ const float y = {_UP.format('x', 'm')}; if (lane >= m) x += y; }}"


@dataclass(frozen=True)
class Drive:
    """Joint that one drive moves."""

    row: int
    """Its row of the matrix from controls to targets."""
    dof: int
    coordinate: int
    mode: str
    """``acceleration``, ``velocity`` or ``position``."""


def targets(name: str, control: str, matrix: np.ndarray) -> list[str]:
    """Statements that define what controls ask of the joints: ``{name}0``, ``{name}1``, ..."""
    lines = Lines(f"{name}_")
    for d, row in enumerate(matrix):
        value = lines.sum(*((float(row[u]), f"{control}{u}") for u in np.flatnonzero(row)))
        lines.add(f"const T {name}{d} = {text(value)};")
    return lines.statements


def start_cpu(drives: list[Drive], controls: int) -> str:
    """Statements before the first step."""
    out = []
    for d in drives:
        out.append(f"T q{d.coordinate} = (T)q_start[{d.coordinate}], v{d.dof} = (T)qd_start[{d.dof}];")
        out.append(f"T a{d.dof} = (T)0.0f, b{d.dof} = (T)0.0f;")
    out += [f"T d{u}, now{u} = (T)last_control[{u}];" for u in range(controls)]
    return "\n".join(out)


def motion_cpu(drives: list[Drive], matrix: np.ndarray) -> str:
    """The joints one step on, from the step's controls."""
    out = [f"d{u} = now{u}; if (live) now{u} = c{u};" for u in range(matrix.shape[1])]
    out += [*targets("goal", "c", matrix), *targets("earlier", "d", matrix), "if (live) {"]
    for d in drives:
        q, v, a, b, goal = f"q{d.coordinate}", f"v{d.dof}", f"a{d.dof}", f"b{d.dof}", f"goal{d.row}"
        if d.mode == "acceleration":
            out.append(f"{a} = {goal}; {b} = earlier{d.row}; {v} += {a} * dt;")
        else:
            speed = goal if d.mode == "velocity" else f"({goal} - {q}) / dt"
            out.append(f"{{ const T speed = {speed}, pace = (speed - {v}) / dt;")
            out.append(f"{b} = h == 0 ? pace : {a}; {a} = pace; {v} = speed; }}")
        out.append(f"{q} += {v} * dt;")
    return "\n".join((*out, "}"))


def start_gpu(drives: list[Drive], controls: int) -> str:
    """Statements before the first block of steps."""
    out = []
    for d in drives:
        out.append(f"T q_in{d.coordinate} = q_start[{d.coordinate}], v_in{d.dof} = qd_start[{d.dof}];")
        out.append(f"T a_in{d.dof} = 0.0f;")
    out += [f"T c_in{u} = 0.0f;" for u in range(controls)]
    return "\n".join(out)


def motion_gpu(drives: list[Drive], matrix: np.ndarray) -> str:
    """The joints at every lane's step."""
    out = []
    for u in range(matrix.shape[1]):
        out.append(f"float {before(f'd{u}', f'c{u}', f'c_in{u}')} if (h <= 0) d{u} = last_control[{u}];")
        out.append(carry(f"c_in{u}", f"c{u}"))
    out += [*targets("goal", "c", matrix), *targets("earlier", "d", matrix)]
    for d in drives:
        q, v, a, b, goal = f"q{d.coordinate}", f"v{d.dof}", f"a{d.dof}", f"b{d.dof}", f"goal{d.row}"
        q_in, v_in, a_in = f"q_in{d.coordinate}", f"v_in{d.dof}", f"a_in{d.dof}"
        if d.mode == "position":
            out.append(f"const float {q} = live ? {goal} : {q_in};")
            out.append(f"float {before('x' + q, q, q_in)}")
            out.append(f"const float {v} = live ? ({q} - x{q}) / dt : {v_in};")
        else:
            if d.mode == "velocity":
                out.append(f"const float {v} = live ? {goal} : {v_in};")
            else:
                out.append(f"float {v}; {{ float x = live ? {goal} * dt : 0.0f;\n{_SCAN}\n{v} = {v_in} + x; }}")
            out.append(f"float {q}; {{ float x = live ? {v} * dt : 0.0f;\n{_SCAN}\n{q} = {q_in} + x; }}")
        if d.mode == "acceleration":
            out.append(f"const float {a} = live ? {goal} : 0.0f, {b} = earlier{d.row};")
        else:
            out.append(f"float {before('x' + v, v, v_in)} const float {a} = live ? ({v} - x{v}) / dt : 0.0f;")
            out.append(f"float {before(b, a, a_in)} if (h <= 0) {b} = {a};")
        out += [carry(q_in, q), carry(v_in, v), carry(a_in, a)]
    return "\n".join(out)


def before(name: str, value: str, carried: str) -> str:
    """Definition of a value one step before, from the lane below."""
    return f"{name} = {_UP.format(value, 1)}; if (lane == 0) {name} = {carried};"


def carry(name: str, value: str) -> str:
    """Keep the last lane's value for the next block."""
    return f"{name} = {own(value, WARP - 1)};"


def own(value: str, lane: int) -> str:
    """The value of one lane, for all of them."""
    return f"__shfl_sync(0xffffffffu, {value}, {lane})"
