# SPDX-License-Identifier: Apache-2.0
"""Baked source of the terms that push an object, beside ``kernels.terms.pushing``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from ...bake.lines import Operand, literal, text
from ...bake.simd import angle, direction
from ...kernels.geometry.fields import ATAN_HALF
from ...kernels.terms.pushing import (
    BESIDE_CORNER,
    COAST_RANGE,
    EPSILON,
    SWIVEL_PLAY,
    SWIVEL_PRICE,
    SWIVEL_RANGE,
    WHOLE_SIDE,
    WHOLE_TURN,
)
from .paths import BETWEEN, PLACE, detour
from .variables import heading, variable

if TYPE_CHECKING:
    from ...cost.code.state import TermCode


def push_path(code: TermCode, p: Any) -> Operand:
    """``pushing.push_path``: one lookup of the value where the pusher is at the object for all lanes, else seven."""
    state, lines, params = code.state, code.lines, code.params
    pusher, box, goal = (state.frame(i) for i in (p.pusher, p.object, p.goal))
    o = box.position
    if p.lead > 0.0:
        velocity, _ = state.velocity(p.object)
        if not p.through:
            o = [lines.sum(x, (f"{params}.lead", v)) for x, v in zip(o, velocity, strict=True)]
    total = variable(code, "work", "(T)0.0f")
    c, s = heading(code, goal.columns[0])
    lines.add("{ // in the goal's frame")
    vectors = [("off", lines.difference(o, goal.position)), ("arm", lines.difference(pusher.position, o))]
    if p.through:
        vectors.append(("roll", velocity))
    for name, v in vectors:
        x, y = text(v[0]), text(v[1])
        lines.add(f"T {name}_x = {c} * {x} + {s} * {y}, {name}_y = {c} * {y} - {s} * {x};")
    if p.through:
        lines.add(_COAST.format(params=params, **_COAST_NUMBERS))
    lines.add("const T apart = VSQRT(arm_x * arm_x + arm_y * arm_y);")
    lines.add(direction("arm_y", "arm_x", "bearing"))
    lines.add(f"T tolerance = (T){params}.tolerance, turning = (T)0.0f;")
    if p.faces:
        cosine, sine = heading(code, box.columns[0])
        lines.add(f"const T error_c = {c} * {cosine} + {s} * {sine}, error_s = {c} * {sine} - {s} * {cosine};")
        lines.add(_faces(p, params))
    lines.add(_lookup(params))
    if p.steer > 0.0 and p.faces:
        slow = f"VMAX(1.0f - VSQRT(at_x * at_x + at_y * at_y) * {literal(1.0 / float(SWIVEL_RANGE))}, 0.0f)"
        lines.add(f"turning = turning * {slow};")
    lines.add(f"{total} = value(bearing);")
    lines.add(f"const float radius = {params}.radius, turn = {params}.turn;")
    lines.add("if (VANY(apart > radius)) {")
    lines.add(_WALK.format(seen=angle("sine", "cosine", "seen"), total=total))
    longer = detour(code, p.field, pusher.position)
    lines.add(f"{total} = VSELECT(apart > radius, best + turn * {longer}, {total}); }}")
    lines.add(f"{total} = {total} + turning + beyond; }}")
    return total


def _faces(p: Any, params: str) -> str:
    """Sides of the object: ``bearing`` is turned to the place from where a push goes straight."""
    broad_c, broad_s = literal(math.cos(p.broad)), literal(math.sin(p.broad))
    swivel = _SWIVEL.format(params=params, broad=literal(p.broad), **_SWIVEL_NUMBERS) if p.steer > 0.0 else ""
    return f"""{direction("error_s", "error_c", "error")}
const T side_c = error_c * {broad_c} - error_s * {broad_s}, side_s = error_s * {broad_c} + error_c * {broad_s};
const T size = VABS(error);
{swivel}
const T nearby = VMAX(apart, {literal(1e-30)});
const T across = VSELECT(apart > 0.0f, arm_x * side_c + arm_y * side_s, side_c) / VSELECT(apart > 0.0f, nearby, 1.0f);
{_SIDE.format(params=params, **_SIDE_NUMBERS)}"""


_COAST = """{{ const float lead = {params}.lead, within = {params}.tolerance;
const T along = off_x * roll_x + off_y * roll_y, speed = VMAX(roll_x * roll_x + roll_y * roll_y, {epsilon});
const T nearest = VMIN(VMAX(-along / speed, 0.0f), lead);
const T outside_x = VMAX(VABS(off_x + nearest * roll_x) - within, 0.0f);
const T outside_y = VMAX(VABS(off_y + nearest * roll_y) - within, 0.0f);
const T past = VMIN(VSQRT(outside_x * outside_x + outside_y * outside_y) * {per_range}, 1.0f);
const T time = nearest * (1.0f - past) + lead * past;
off_x = off_x + time * roll_x; off_y = off_y + time * roll_y;
arm_x = arm_x - time * roll_x; arm_y = arm_y - time * roll_y; }}"""
"""``pushing.coasting_time``, and both places after it."""
_COAST_NUMBERS = {"epsilon": literal(float(EPSILON)), "per_range": literal(1.0 / float(COAST_RANGE))}

_SWIVEL = """tolerance = tolerance * (1.0f + {play} * VMIN(size, 1.0f));
const T aside = (off_x * side_c + off_y * side_s) / VMAX({params}.tolerance, {epsilon});
const T off = bearing - error - {broad} + VSELECT(error < 0.0f, (T)(-{params}.arm), (T){params}.arm);
const T nearest = VABS(off - {pi} * VROUND(off * {halves}));
const T outwards = off + VSELECT(aside < 0.0f, (T){pi}, (T)0.0f);
const T outer = VABS(outwards - {whole} * VROUND(outwards * {turns}));
const T share = VMIN(2.0f * VABS(aside), 1.0f);
turning = {price} * {params}.turn * VMIN(apart, {params}.radius) * (nearest * (1.0f - share) + outer * share)
    * VMIN(size * {count}, 1.0f);"""
"""``pushing.swivel``, and what it is worth."""
_SWIVEL_NUMBERS = {
    "play": literal(float(SWIVEL_PLAY)),
    "epsilon": literal(float(EPSILON)),
    "pi": literal(math.pi),
    "halves": literal(1.0 / math.pi),
    "whole": literal(2.0 * math.pi),
    "turns": literal(0.5 / math.pi),
    "price": literal(float(SWIVEL_PRICE)),
    "count": literal(1.0 / float(WHOLE_TURN)),
}

_SIDE = """const T largest = {params}.aim[0] * (1.0f - across * across) + {params}.aim[1] * (across * across);
const T turned = size - {half_pi} * VFLOOR((size + {twelfth}) * {quarters});
const T aim = VMIN((1.0f + {params}.steer) * size, largest);
const T onwards = (turned - {last}) * {per_twelfth}, towards = (turned - {side}) * {per_rest};
const T next = {last_place} * (1.0f - onwards) - ({twelfth} + aim) * onwards;
const T before = ({side} - aim) * (1.0f - towards) + {beside} * towards;
T place = VSELECT(turned > {side}, before, turned - aim);
place = VSELECT(turned > {corner}, turned - {corner} + {beside}, place);
place = VSELECT(turned > {last}, next, place);
bearing = bearing - VSELECT(error < 0.0f, -place, place);"""
"""``pushing.side_place``."""
_SIDE_NUMBERS = {
    "half_pi": literal(math.pi / 2),
    "twelfth": literal(math.pi / 12),
    "quarters": literal(2 / math.pi),
    "last": literal(math.pi / 3),
    "per_twelfth": literal(12 / math.pi),
    "side": literal(float(WHOLE_SIDE)),
    "per_rest": literal(1.0 / (math.pi / 4 - float(WHOLE_SIDE))),
    "last_place": literal(math.pi / 12 + float(BESIDE_CORNER)),
    "beside": literal(float(BESIDE_CORNER)),
    "corner": literal(math.pi / 4),
}


def _lookup(params: str) -> str:
    """``value`` of a bearing as in ``fields.sample_push``, but for what lies ``beyond`` the grid."""
    shrunk = "".join(
        f"const T size_{axis} = VABS(off_{axis});"
        f" const T less_{axis} = VMAX(size_{axis} - tolerance, 0.0f) * {literal(2.5 / 1.5)};"
        f" const T left_{axis} = VSELECT(size_{axis} < 2.5f * tolerance, less_{axis}, size_{axis});"
        f" const T at_{axis} = VSELECT(off_{axis} < 0.0f, -left_{axis}, left_{axis});\n"
        for axis in "xy"
    )
    nearby = [f"VGATHER(cells, here + {offset})" for offset in ("0", "16", "row", "(row + 16)")]
    own = [f"VLOAD(of + {offset})" for offset in ("side", "(16 + side)", "(row + side)", "(row + 16 + side)")]
    return f"""{shrunk}const int rows = {params}.value.shape[1], columns = {params}.value.shape[2], row = 16 * columns;
const float* cells = (const float*){params}.value.data + (size_t)e * rows * row;
const float* origin = (const float*){params}.origin.data + 2 * e;
const float cell = {params}.cell, origin_x = origin[0], origin_y = origin[1];
const T px = at_x, py = at_y;
{PLACE}
const T over_x = px - VMIN(VMAX(px, origin_x), origin_x + cell * (columns - 1.0f));
const T over_y = py - VMIN(VMAX(py, origin_y), origin_y + cell * (rows - 1.0f));
const T beyond = VSQRT(over_x * over_x + over_y * over_y);
#if defined(__CUDA_ARCH__)
const auto side = [&](I of) -> T {{
const I here = 16 * at + (of & 15);
return {BETWEEN.format(*nearby)};
}};
#else
{_ALL_SIDES.format(between=BETWEEN.format(*own))}
#endif
const auto value = [&](T towards) -> T {{
const T quarters = towards * {literal(2 / math.pi)};
const T quarter = VFLOOR(quarters);
const T within = (quarters - quarter) * {literal(math.pi / 2)};
const T mirrored = VMIN(within, {literal(math.pi / 2)} - within);
const T steep = 1.0f + (mirrored - {_STEP}) * {literal(1.0 / (math.pi / 4 - float(ATAN_HALF)))};
const T part = VSELECT(mirrored > {_STEP}, steep, mirrored * {literal(1.0 / float(ATAN_HALF))});
const T index = 4.0f * (quarter - 4.0f * VFLOOR(0.25f * quarter)) + VSELECT(within > mirrored, 4.0f - part, part);
const I low = VINT(index);
const T share = index - VFLOAT(low);
return (1.0f - share) * side(low) + share * side(low + 1);
}};"""


_ALL_SIDES = """enum {{ WORLDS = sizeof(T) / sizeof(float) }};
float sides[16 * WORLDS], us[WORLDS], vs[WORLDS];
I own;
VSTORE(us, u);
VSTORE(vs, v);
for (int l = 0; l < WORLDS; ++l) {{
const float* of = cells + 16 * at[l];
const T u = (T)us[l], v = (T)vs[l];
own[l] = 16 * l;
for (int side = 0; side < 16; side += WORLDS) VSTORE(sides + 16 * l + side, {between});
}}
const auto side = [&](I of) -> T {{ return VGATHER(sides, own + (of & 15)); }};"""
"""``side`` on a CPU: one world after the other all its sides, which lie side by side, in one or a few registers."""
_STEP = literal(float(ATAN_HALF))
_WALK = """const T cosine = VMIN(radius / VMAX(apart, radius), 1.0f);
const T sine = VSQRT((1.0f - cosine) * (1.0f + cosine));
{seen}
const T third = seen * 0.333333333f, sixth = seen * 0.1666666667f, w = sixth * sixth;
const T half = 2.0f * sixth * (1.0f - w * (0.1666666667f - w * (0.00833333333f - w * 0.000198412698f)));
const T chord = half * half; // (2 sin of half a third of it)²
const T gap = apart - radius;
const T squared = gap * gap, area = apart * radius;
T best = {total} + turn * gap;
const T one = VSQRT(squared + area * chord);
best = VMIN(best, VMIN(value(bearing + third), value(bearing - third)) + turn * one);
const T two = VSQRT(squared + area * (chord * (4.0f - chord)));
best = VMIN(best, VMIN(value(bearing + 2.0f * third), value(bearing - 2.0f * third)) + turn * two);
const T three = VSQRT(squared + area * (chord * (3.0f - chord) * (3.0f - chord)));
best = VMIN(best, VMIN(value(bearing + seen), value(bearing - seen)) + turn * three);"""
"""``best`` of the places on a circle around the object that the pusher sees, and the straight way there."""
