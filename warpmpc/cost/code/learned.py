# SPDX-License-Identifier: Apache-2.0
"""Source of the learned collision terms: a network over as many samples as a number holds.

Weights are read from arrays; what is written out is the number of units alone. On a CPU a block of units at a time
stays in registers, each weight multiplied with all samples; on a GPU a thread has all units of the second row.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...physics.runtime.bake import sincos, text
from .collision import Grid, nearest

if TYPE_CHECKING:
    from ...physics.runtime.bake import Operand
    from .state import TermCode

FIRST = 8
"""Units of the first row that a CPU works on at a time."""
SECOND = 16
"""Units of the second row: what a CPU holds in registers besides inputs and weights."""


def learned_self_collision(code: TermCode, p: Any) -> Operand | None:
    """``learned.learned_self_collision``; None for networks whose units are no multiples of a block."""
    rows, units = p.first.shape[0], p.second.shape[1]
    if rows % FIRST or units % SECOND:
        return None
    add, own, name = code.lines.add, code.params, code.params.replace(".", "_")
    sines, cosines = [], []
    for i, coord in enumerate(p.coord.numpy()):
        sines.append(f"s{i}_{name}")
        cosines.append(f"c{i}_{name}")
        add(sincos(code.state.coordinate(int(coord)), sines[-1], cosines[-1]))
    inputs = [*sines, *cosines]
    add(f"T depth_{name};\n{{\nconst T inputs[{len(inputs)}] = {{{', '.join(inputs)}}};")
    for array in ("first", "second", "last"):
        add(f"const float* {array} = (const float*){own}.{array}.data;")
    add(_network(len(inputs), rows, units))
    add(f"depth_{name} = depth;\n}}")
    return code.lines.let(f"VMAX({own}.margin + depth_{name}, 0.0f)")


def learned_cloud_collision(code: TermCode, p: Any) -> Operand | None:
    """``learned_cloud.learned_cloud_collision``; a loop over links whose poses are written down first."""
    links, probes = p.probe.shape
    rows, units = p.first.shape[0] // links, p.second.shape[1]
    if rows % FIRST or units % SECOND:
        return None
    add, own, state = code.lines.add, code.params, code.state
    poses, bounds = [], []
    for body, middle in zip(p.body.numpy(), p.middle.numpy(), strict=True):
        columns, origin = state.body_columns(int(body)), state.body_point(int(body), np.zeros(3))
        poses.append(f"{{{', '.join(f'(T)({text(x)})' for x in (*origin, *(x for c in columns for x in c)))}}}")
        bounds.append(f"{{{', '.join(f'(T)({text(x)})' for x in state.body_point(int(body), middle))}}}")
    volume = p.volume
    grid = Grid(tuple(volume.origin), float(volume.inverse), (volume.nx, volume.ny, volume.nz))
    hit, voxels = code.variable("hit", "(T)0.0f"), volume.nx * volume.ny * volume.nz
    at = [f"(pose[{i}] + {' + '.join(f'pose[{3 * j + i + 3}] * probe[{j}]' for j in range(3))})" for i in range(3)]
    add(f"{{ const T poses[{links}][12] = {{{', '.join(poses)}}};")
    add(f"const T bounds[{links}][3] = {{{', '.join(bounds)}}};")
    add(f"const float* vol = (const float*){own}.volume.distance.data + (size_t)e * {voxels};")
    add(f"for (int link = 0; link < {links}; ++link) {{")
    add("const T* pose = poses[link]; const T* bound = bounds[link]; T apart;")
    add(f"{{ T d = (T)1.0e6f; {nearest(['bound[0]', 'bound[1]', 'bound[2]'], grid)} apart = d; }}")
    add(f"const float near = ((const float*){own}.near.data)[link];")
    add("if (!VANY(apart < near)) continue;")
    add(f"T inputs[{probes}]; const float* probe = (const float*){own}.probe.data + {3 * probes} * link;")
    add(f"for (int i = 0; i < {probes}; ++i, probe += 3) {{")
    add(f"T d = (T){own}.reach; {nearest(at, grid)} inputs[i] = d; }}")
    sizes = {"first": rows * (probes + 1), "second": (rows + 1) * units, "last": units + 1}
    for array, size in sizes.items():
        add(f"const float* {array} = (const float*){own}.{array}.data + {size} * link;")
    add(_network(probes, rows, units))
    add(f"{hit} = VSELECT((apart < near) & (depth > {own}.logit), 1.0f, {hit});\n}} }}")
    return code.lines.let(hit)


def _network(inputs: int, rows: int, units: int) -> str:
    """Source of a network: from ``inputs``, ``first``, ``second`` and ``last`` to ``depth``."""
    source = _NETWORK
    sizes = {"INPUTS": inputs, "ROWS": rows, "UNITS": units, "FIRST": FIRST, "SECOND": SECOND}
    for word, size in sizes.items():
        source = source.replace(word, str(size))
    return source


_NETWORK = """T depth = (T)last[UNITS];
#if defined(__CUDA_ARCH__)
T sums[UNITS];
#pragma unroll
for (int u = 0; u < UNITS; ++u) sums[u] = second[ROWS * UNITS + u];
for (int j = 0; j < ROWS; ++j, first += INPUTS + 1, second += UNITS) {
T x = first[INPUTS];
#pragma unroll
for (int i = 0; i < INPUTS; ++i) x += first[i] * inputs[i];
x = VMIN(VMAX(x, 0.0f), 6.0f);
#pragma unroll
for (int u = 0; u < UNITS; ++u) sums[u] += x * second[u];
}
#pragma unroll
for (int u = 0; u < UNITS; ++u) depth += last[u] * VMIN(VMAX(sums[u], 0.0f), 6.0f);
#else
T row[ROWS];
for (int j = 0; j < ROWS; j += FIRST) {
const float* weight = first + j * (INPUTS + 1);
T sums[FIRST];
#pragma unroll
for (int k = 0; k < FIRST; ++k) sums[k] = (T)weight[k * (INPUTS + 1) + INPUTS];
#pragma unroll
for (int i = 0; i < INPUTS; ++i) {
#pragma unroll
for (int k = 0; k < FIRST; ++k) sums[k] += weight[k * (INPUTS + 1) + i] * inputs[i];
}
#pragma unroll
for (int k = 0; k < FIRST; ++k) row[j + k] = VMIN(VMAX(sums[k], 0.0f), 6.0f);
}
for (int u = 0; u < UNITS; u += SECOND) {
T sums[SECOND];
#pragma unroll
for (int k = 0; k < SECOND; ++k) sums[k] = (T)second[ROWS * UNITS + u + k];
const float* weight = second + u;
for (int j = 0; j < ROWS; ++j, weight += UNITS) {
const T x = row[j];
#pragma unroll
for (int k = 0; k < SECOND; ++k) sums[k] += x * weight[k];
}
#pragma unroll
for (int k = 0; k < SECOND; ++k) depth += last[u + k] * VMIN(VMAX(sums[k], 0.0f), 6.0f);
}
#endif
"""
