# SPDX-License-Identifier: Apache-2.0
"""Source of the learned collision terms: a network over as many samples as a number holds.

Weights are read from arrays; what is written out is the number of units alone. On a CPU a block of units at a time
stays in registers, each weight multiplied with all samples; on a GPU a thread has all units of the second row.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...bake.simd import sincos

if TYPE_CHECKING:
    from ...bake.lines import Operand
    from ...cost.code.state import TermCode

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
    sizes = {"INPUTS": len(inputs), "ROWS": rows, "UNITS": units, "FIRST": FIRST, "SECOND": SECOND}
    source = _NETWORK.replace("NAME", name).replace("OWN", own).replace("VALUES", ", ".join(inputs))
    for word, size in sizes.items():
        source = source.replace(word, str(size))
    add(source)
    return code.lines.let(f"VMAX({own}.margin + depth_{name}, 0.0f)")


_NETWORK = """T depth_NAME;
{
const T inputs[INPUTS] = {VALUES};
const float* first = (const float*)OWN.first.data;
const float* second = (const float*)OWN.second.data;
const float* last = (const float*)OWN.last.data;
T depth = (T)last[UNITS];
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
depth_NAME = depth;
}"""
