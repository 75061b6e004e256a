# SPDX-License-Identifier: Apache-2.0
"""Baked source of the terms of an arm (Bhardwaj et al., STORM, CoRL 2021)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...bake.lines import Operand, Vector, text
from .general import beyond, length, squares

if TYPE_CHECKING:
    from ..code.state import TermCode
    from ..code.tree import Axis


def pose(code: TermCode, p: Any) -> Operand:
    """``arm.pose``: Σ r_i ‖R e_i - R_g e_i‖ + ‖p_w ⊙ R_gᵀ(p - p_g)‖."""
    lines, params = code.lines, code.params
    frame, goal = code.state.frame(p.of), code.state.frame(p.to)
    d = lines.difference(frame.position, goal.position)
    if p.planar:
        d[2] = 0.0
    turned = [text(lines.dot(axis, d)) for axis in goal.columns]
    away = length(code, [lines.let(f"{params}.position[{i}] * {x}") for i, x in enumerate(turned)])
    total = [away]
    for i in range(3):
        if p.rotation[i] != 0.0:
            miss = length(code, lines.difference(frame.columns[i], goal.columns[i]))
            total.append(lines.let(f"{params}.rotation[{i}] * {miss}"))
    return lines.sum(*total)


def stop(code: TermCode, p: Any) -> Operand:
    """``arm.stop``: Σ max(0, |q̇| - a_max Σ_{k≥h} dt_k)² (Eq. 9)."""
    speeds = [(n, code.state.speed(int(dof))) for n, dof in enumerate(p.joint.numpy())]
    bound = code.params + ".acceleration.data[{0}] * left"
    return squares(code, [beyond(code, v, bound.format(n)) for n, v in speeds if isinstance(v, str)])


def joint_bounds(code: TermCode, p: Any) -> Operand:
    """``arm.joint_bounds``; limits that are infinite are left out."""
    state, lines, params, outside = code.state, code.lines, code.params, []

    def limited(kind: str) -> list[tuple[int, int]]:
        finite = np.isfinite(getattr(p, kind).numpy())
        return [(n, int(dof)) for n, dof in enumerate(p.joint.numpy()) if finite[n]]

    for n, _ in limited("reach"):
        q = lines.let(f"{state.coordinate(int(p.coord.numpy()[n]))} - {params}.middle.data[{n}]")
        outside.append(beyond(code, q, f"{params}.reach.data[{n}]"))
    for kind in ("velocity", "acceleration", "jerk"):
        for n, dof in limited(kind):
            if dof in state.moving:
                value = {"velocity": state.speed, "acceleration": state.acceleration}.get(kind, lambda i: jerk(code, i))
                outside.append(beyond(code, value(dof), f"{params}.{kind}.data[{n}]"))
    return squares(code, outside)


def jerk(code: TermCode, dof: int) -> str:
    """Change of a joint's acceleration from the step before, per time between the middles of the two."""
    state = code.state
    return code.lines.let(f"({state.acceleration(dof)} - {state.acceleration_before(dof)}) / gap")


def smoothness(code: TermCode, p: Any) -> Operand:
    """``arm.smoothness``: Σ α q̈² + ζ q⃛²."""
    state, lines = code.state, code.lines
    dofs = [int(dof) for dof in p.joint.numpy() if int(dof) in state.moving]
    a, j = squares(code, [state.acceleration(dof) for dof in dofs]), squares(code, [jerk(code, dof) for dof in dofs])
    return lines.sum((f"{code.params}.acceleration", a), (f"{code.params}.jerk", j))


def speed(code: TermCode, p: Any) -> Operand:
    """``arm.speed``."""
    velocities = zip(("linear", "angular"), code.state.velocity(p.of), strict=True)
    limited = [(name, v) for name, v in velocities if np.isfinite(getattr(p, name))]
    return squares(code, [beyond(code, length(code, v), f"{code.params}.{name}") for name, v in limited])


def manipulability(code: TermCode, p: Any) -> Operand:
    """``arm.manipulability`` (Eq. 10): √det(J Jᵀ), which does not depend on the point that J looks at."""
    state, lines, params = code.state, code.lines, code.params
    axes = chain_axes(code, p)
    turning = [axis for axis in axes if axis.turns]
    # the axes of a wrist meet in one point: from there two of its columns have no linear part
    about = turning[-2 if len(turning) > 1 else -1].origin if turning else state.frame(p.of).position
    columns = [[*(axis.direction if axis.turns else [0.0] * 3), *state.tree.lever(axis, about)] for axis in axes]
    if len(columns) < 6:
        gram = {(i, j): lines.dot(columns[i], columns[j]) for i in range(len(columns)) for j in range(i + 1)}
    else:
        rows = [[column[i] for column in columns] for i in range(6)]
        gram = {(i, j): lines.dot(rows[i], rows[j]) for i in range(6) for j in range(i + 1)}
    _, pivots = factorize(code, gram, min(len(columns), 6))
    m = lines.let(f"VSQRT(VMAX({' * '.join(pivots)}, 0.0f))")
    if p.step:
        return lines.let(f"VSELECT({m} < {params}.least, 1.0f - {m}, 0.0f)")
    return lines.let(f"VMAX(({params}.least - {m}) / {params}.least, 0.0f)")


def null_posture(code: TermCode, p: Any) -> Operand:
    """``arm.null_posture``: ‖(I - J⁺J)(q - q₀)‖²."""
    state, lines = code.state, code.lines
    axes = chain_axes(code, p)
    at = state.frame(p.of).position
    columns = [[*(axis.direction if axis.turns else [0.0] * 3), *state.tree.lever(axis, at)] for axis in axes]
    coords = [int(state.layout.dof_coord[axis.dof]) for axis in axes]
    d = [lines.let(f"{state.coordinate(i)} - {code.params}.target.data[{n}]") for n, i in enumerate(coords)]
    rows = [[column[i] for column in columns] for i in range(6)]
    gram = {(i, j): lines.dot(rows[i], rows[j]) for i in range(6) for j in range(i + 1)}
    for i in range(6):
        gram[i, i] = lines.sum(gram[i, i], f"{code.params}.damping")
    low, pivots = factorize(code, gram, 6)
    x: list[Operand] = []
    for i in range(6):
        x.append(
            lines.sum(lines.dot(rows[i], d), *((-1.0, lines.let(f"{low[i, k]} * {text(x[k])}")) for k in range(i)))
        )
    x = [lines.let(f"{text(y)} / {pivot}") for y, pivot in zip(x, pivots, strict=True)]
    for i in reversed(range(6)):
        x[i] = lines.sum(x[i], *((-1.0, lines.let(f"{low[k, i]} * {x[k]}")) for k in range(i + 1, 6)))
    left = [lines.sum(d[n], (-1.0, lines.dot(column, x))) for n, column in enumerate(columns)]
    return squares(code, left)


def path_deviation(code: TermCode, p: Any) -> Operand:
    """``arm.path_deviation``."""
    state, lines = code.state, code.lines
    at, b = (state.frame(i).position for i in (p.of, p.to))
    a = state.frame(p.start).position if p.start >= 0 else [state.at_start(x) for x in at]
    gone, way = lines.difference(at, a), lines.difference(b, a)
    if p.planar:
        gone[2] = way[2] = 0.0
    along, full = text(lines.dot(gone, way)), text(lines.dot(way, way))
    share = lines.let(f"VMIN(VMAX({along} / VMAX({full}, 1.0e-12f), 0.0f), 1.0f)")
    off: Vector = [lines.sum(g, (-1.0, lines.let(f"{share} * {text(w)}"))) for g, w in zip(gone, way, strict=True)]
    return length(code, off)


def chain_axes(code: TermCode, p: Any) -> list[Axis]:
    """The axes that are columns of a term's Jacobian, in the order of its parameters."""
    place = code.state.frame(p.of).place
    by_coord = {int(code.state.layout.dof_coord[axis.dof]): axis for axis in place.axes}
    return [by_coord[int(i)] for i in p.chain.coord.numpy()[p.chain.column.numpy()]]


def factorize(code: TermCode, gram: dict[tuple[int, int], Operand], n: int) -> tuple[dict, list[str]]:
    """L and D of L D Lᵀ for a symmetric matrix, given by its lower half."""
    lines, pivots = code.lines, []
    low: dict[tuple[int, int], str] = {}
    work: dict[tuple[int, int], str] = {}
    for j in range(n):
        for i in range(j, n):
            taken = "".join(f" - {work[i, k]} * {low[j, k]}" for k in range(j))
            work[i, j] = lines.let(f"{text(gram[i, j])}{taken}")
        pivots.append(lines.let(f"VMAX({work[j, j]}, 1.0e-9f)"))  # what rounding makes of a singular posture
        for i in range(j + 1, n):
            low[i, j] = lines.let(f"{work[i, j]} / {pivots[j]}")
    return low, pivots
