# SPDX-License-Identifier: Apache-2.0
"""Baked source of distances from shapes and outlines, beside ``kernels.terms.clearance``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...bake.lines import Operand, known, literal, text
from ...kernels.terms.clearance import BOX, CAPSULE, CYLINDER, PLANE, SPHERE
from .variables import heading, variable

if TYPE_CHECKING:
    from ..code.state import TermCode

_TURN = " ".join(
    f"const T l{axis} = ob[{3 * i}] * px + ob[{3 * i + 1}] * py + ob[{3 * i + 2}] * pz + ob[{9 + i}];"
    for i, axis in enumerate("xyz")
)
"""A point in the frame of the shape ``ob``, a rotation by rows and a position; its size follows."""
_OUTER = "VSQRT(VMAX(qx, 0.0f) * VMAX(qx, 0.0f) + {0} + VMAX(qz, 0.0f) * VMAX(qz, 0.0f))"
_SURFACE = {
    int(SPHERE): "const T d = VSQRT(lx * lx + ly * ly + lz * lz) - ob[12];",
    int(CAPSULE): "const T qz = lz - VMIN(VMAX(lz, -ob[13]), ob[13]);"
    " const T d = VSQRT(lx * lx + ly * ly + qz * qz) - ob[12];",
    int(PLANE): "const T d = lz;",
    int(BOX): "const T qx = VABS(lx) - ob[12], qy = VABS(ly) - ob[13], qz = VABS(lz) - ob[14];"
    f" const T d = {_OUTER.format('VMAX(qy, 0.0f) * VMAX(qy, 0.0f)')} + VMIN(VMAX(qx, VMAX(qy, qz)), 0.0f);",
    int(CYLINDER): "const T qx = VSQRT(lx * lx + ly * ly) - ob[12], qz = VABS(lz) - ob[13];"
    f" const T d = {_OUTER.format('0.0f')} + VMIN(VMAX(qx, qz), 0.0f);",
}
"""Distance ``d`` from a shape's surface, as in ``clearance.shape_distance``."""
_CENTRE = "const T d = VSQRT(lx * lx + ly * ly + lz * lz);"


def obstacle_clearance(code: TermCode, p: Any) -> Operand:
    """``clearance.obstacle_clearance``: a loop over the obstacles of each kind, whose places are written out."""
    total, add = variable(code, "nearness", "(T)0.0f"), code.lines.add
    position = ", ".join(f"p{a} = {text(x)}" for a, x in zip("xyz", code.state.frame(p.of).position, strict=True))
    kinds, poses, sizes = p.kind.numpy(), p.pose.numpy(), p.size.numpy()
    # distances from centres are the same for all kinds
    groups = [np.flatnonzero(kinds == kind) for kind in np.unique(kinds)] if p.surface else [np.arange(len(kinds))]
    add(f"{{ const T {position};")
    for which in filter(len, groups):
        rows: list[float] = []
        for k in which:
            turn = Rotation.from_quat(poses[k, 3:]).as_matrix().ravel()
            rows += [*known(turn), *poses[k, :3].tolist(), *sizes[k].tolist()]
        distance = _SURFACE[int(kinds[which[0]])] if p.surface else _CENTRE
        add(f"{{ const float obstacles[{len(rows)}] = {{{', '.join(map(literal, rows))}}};")
        add(f"for (int n = 0; n < {len(which)}; ++n) {{ const float* ob = obstacles + 15 * n;")
        add(f"{_TURN} {distance}")
        add(f"{total} = {total} + 1.0f / VMAX(d - {code.params}.radius, {code.params}.least); }} }}")
    add("}")
    return total


def outline_clearance(code: TermCode, p: Any) -> Operand:
    """``clearance.outline_clearance``; an obstacle is looked at where it is near for any lane."""
    params, add = code.params, code.lines.add
    frame, corners = code.state.frame(p.of), int(p.count.numpy()[0])
    total = variable(code, "nearness", "(T)0.0f")
    c, s = heading(code, frame.columns[0])
    x, y = (text(a) for a in frame.position[:2])
    edges = ", ".join(literal(x) for x in _inverse_lengths(p))
    add(f"""{{ const float edge[] = {{{edges}}}; // 1 / length
const float* corner = (const float*){params}.corner.data;
const float* centre = (const float*){params}.centre.data;
const float within = {params}.within, own = {params}.radius.data[0];
const T mx = {x} + {c} * centre[0] - {s} * centre[1], my = {y} + {s} * centre[0] + {c} * centre[1];
for (int k = 1; k < {len(p.first)}; ++k) {{
const float reach = own + {params}.radius.data[k] + within;
const T ax = mx - centre[2 * k], ay = my - centre[2 * k + 1], away = ax * ax + ay * ay;
if (!VANY(away < reach * reach)) continue;
T px[{corners}], py[{corners}], nearest = (T)1.0e30f, gap = (T)-1.0e30f, outwards;
for (int i = 0; i < {corners}; ++i) {{
px[i] = {x} + {c} * corner[2 * i] - {s} * corner[2 * i + 1];
py[i] = {y} + {s} * corner[2 * i] + {c} * corner[2 * i + 1];
}}
const auto past = [&](T ox, T oy, T ex, T ey, float inverse) {{
const T along = VMIN(VMAX((ox * ex + oy * ey) * (inverse * inverse), 0.0f), 1.0f);
const T dx = ox - along * ex, dy = oy - along * ey;
nearest = VMIN(nearest, dx * dx + dy * dy);
outwards = VMIN(outwards, (ox * ey - oy * ex) * inverse);
}};
const int first = {params}.first.data[k], count = {params}.count.data[k];
const float* other = corner + 2 * first;
for (int i = 0; i < count; ++i) {{
const float* a = other + 2 * i;
const float* b = other + (i + 1 < count ? 2 * i + 2 : 0);
const float ex = b[0] - a[0], ey = b[1] - a[1];
outwards = (T)1.0e30f;
for (int n = 0; n < {corners}; ++n) past(px[n] - a[0], py[n] - a[1], (T)ex, (T)ey, edge[first + i]);
gap = VMAX(gap, outwards);
}}
for (int i = 0; i < {corners}; ++i) {{
const int j = i + 1 < {corners} ? i + 1 : 0;
const T ex = px[j] - px[i], ey = py[j] - py[i];
outwards = (T)1.0e30f;
for (int n = 0; n < count; ++n) past(other[2 * n] - px[i], other[2 * n + 1] - py[i], ex, ey, edge[i]);
gap = VMAX(gap, outwards);
}}
const T least = VMIN(VSELECT(gap < 0.0f, gap, VSQRT(nearest)), within);
{total} = {total} + VSELECT(away < reach * reach, 1.0f - least / within, 0.0f);
}} }}""")
    return total


def _inverse_lengths(p: Any) -> np.ndarray:
    """1 / length of the edge that begins at each corner."""
    corner, out = p.corner.numpy(), []
    for first, count in zip(p.first.numpy(), p.count.numpy(), strict=True):
        outline = corner[first : first + count].astype(float)
        out.append(1.0 / np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1))
    return np.concatenate(out)


def outline_distance(code: TermCode, p: Any) -> Operand:
    """``clearance.outline_distance``: the shape's place in its object is written out."""
    lines = code.lines
    at, shape = code.state.frame(p.of).position, code.state.frame(p.object)
    away = lines.difference(at, shape.position)
    pose = np.array(p.pose, dtype=float)
    rows = Rotation.from_quat(pose[3:]).as_matrix()
    local = [lines.dot(column, away) for column in shape.columns]
    x, y = (
        text(lines.sum(float(shift), *zip(known(row), local, strict=True)))
        for row, shift in zip(rows[:2], pose[:2], strict=True)
    )
    if p.kind == int(BOX):
        qx, qy = (lines.let(f"VABS({v}) - {code.params}.size[{i}]") for i, v in enumerate((x, y)))
        ox, oy = (lines.let(f"VMAX({q}, 0.0f)") for q in (qx, qy))
        d = lines.let(f"VSQRT({ox} * {ox} + {oy} * {oy}) + VMIN(VMAX({qx}, {qy}), 0.0f)")
    else:
        d = lines.let(f"VSQRT({x} * {x} + {y} * {y}) - {code.params}.size[0]")
    return lines.let(f"VSELECT({d} < 0.0f, -{code.params}.inside * {d}, {d})")
