# SPDX-License-Identifier: Apache-2.0
"""Baked source of distances from shapes and outlines, beside ``kernels.terms.clearance``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...bake.lines import Operand, literal, text
from .variables import heading, variable

if TYPE_CHECKING:
    from ...cost.code.state import TermCode


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
