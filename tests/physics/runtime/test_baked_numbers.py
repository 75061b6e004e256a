# SPDX-License-Identifier: Apache-2.0
"""Functions of the number type of baked source against NumPy's."""

import numpy as np
import pytest
import warp as wp

from warpmpc.physics.runtime.bake import WIDE, direction, header, native_lanes


def directions(height: np.ndarray, width: np.ndarray, lanes: int) -> np.ndarray:
    """Angles of points ``[n]``, n a multiple of the lanes."""
    statements = direction("h", "w", "found")
    loads = f"const T h = VLOAD(height.data + {lanes} * i), w = VLOAD(width.data + {lanes} * i);"
    source = f"{header(lanes)}{loads}\n{statements}\nVSTORE(out.data + {lanes} * i, found);"

    @wp.func_native(source)
    def write(height: wp.array[float], width: wp.array[float], out: wp.array[float], i: int): ...

    options = {"cpu_compiler_flags": WIDE} if lanes == 16 else {}

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def direction_kernel(height: wp.array[float], width: wp.array[float], out: wp.array[float]):
        write(height, width, out, wp.tid())

    points = [wp.array(x, dtype=float, device="cpu") for x in (height, width)]
    out = wp.zeros(len(height), dtype=float, device="cpu")
    wp.launch(direction_kernel, len(height) // lanes, points, [out], device="cpu")
    return out.numpy()


@pytest.mark.parametrize("lanes", sorted({4, native_lanes()}))
def test_directions_are_right_in_all_quadrants_and_on_the_axes(lanes):
    eighths = np.arange(-8, 9) * np.pi / 8
    turns = np.concatenate([np.linspace(-3.141, 3.141, 4000 - 51), *(eighths + d for d in (-1e-4, 0.0, 1e-4))])
    size = np.geomspace(1e-6, 1e6, len(turns))[np.random.default_rng(0).permutation(len(turns))]
    height, width = (size * f(turns) for f in (np.sin, np.cos))
    height, width = height.astype(np.float32), width.astype(np.float32)
    exact = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (-1.0, 0.0), (1e-30, 1.0), (-1e-30, 1.0), (1.0, 1.0), (-1.0, 1.0)]
    height[:8], width[:8] = np.array(exact, np.float32).T
    expected = np.arctan2(height.astype(float), width.astype(float))
    np.testing.assert_allclose(directions(height, width, lanes), expected, rtol=0, atol=1e-6)


def test_the_direction_to_the_left_is_half_a_turn():
    found = directions(np.zeros(16, np.float32), np.full(16, -2.0, np.float32), native_lanes())
    np.testing.assert_allclose(np.abs(found), np.pi, rtol=1e-6)
