# SPDX-License-Identifier: Apache-2.0
"""Long tables are packed for a CPU, and hold the same bits."""

import numpy as np
import warp as wp

from warpmpc.physics.source_parts import floats, ints, packed

N = 4000
READ = "out[i] = t[i]; counts[i] = n[i] + k[i];"


def test_packed_tables_hold_the_same_bits():
    rng = np.random.default_rng(0)
    values = (rng.standard_normal(N) * 10.0 ** rng.integers(-30, 30, N)).astype(np.float32)
    values[:3] = 0.0, -0.0, np.finfo(np.float32).max
    whole, small = rng.integers(-(2**31), 2**31 - 70_000, N), rng.integers(-(2**15), 2**15, N)
    lines = floats("t", values), ints("n", whole), ints("k", small, "short"), ints("few", [1, 2, 3]), READ
    source = packed("\n".join(lines))
    assert source.count("_bytes[]") == 3
    assert "few[3] = {1, 2, 3};" in source

    @wp.func_native(source)
    def read(i: int, out: wp.array[float], counts: wp.array[int]): ...

    @wp.kernel(module="unique", enable_backward=False)
    def read_kernel(out: wp.array[float], counts: wp.array[int]):
        read(wp.tid(), out, counts)

    out, counts = wp.zeros(N, dtype=float, device="cpu"), wp.zeros(N, dtype=int, device="cpu")
    wp.launch(read_kernel, dim=N, outputs=[out, counts], device="cpu")
    assert (out.numpy().view(np.int32) == values.view(np.int32)).all()
    assert (counts.numpy() == whole + small).all()


def test_a_long_line_that_is_no_table_stays():
    line = "static const auto f = [](float x) { return x" + " + x" * 8000 + "; };"
    assert packed(line) == line
