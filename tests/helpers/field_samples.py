# SPDX-License-Identifier: Apache-2.0
"""Kernels that sample tables over a grid of the ground plane, launched at some points."""

import numpy as np
import warp as wp

ORIGIN, CELL = (-1.5, 0.7), 0.25


def sampled(kernel: wp.Kernel, table: np.ndarray, points, *more, outputs=(float,), device: str) -> list[np.ndarray]:
    """Outputs [F, n], each of its own type, of tables [F, ...] at points [n, 2] with more numbers [n]."""
    found = [wp.zeros((len(table), len(points)), dtype=dtype, device=device) for dtype in outputs]
    inputs = [wp.array(table, dtype=float, device=device), wp.vec2(*ORIGIN), CELL]
    inputs.append(wp.array(points, dtype=wp.vec2, device=device))
    inputs += [wp.array(numbers, dtype=float, device=device) for numbers in more]
    wp.launch(kernel, dim=found[0].shape, inputs=inputs, outputs=found, device=device)
    return [array.numpy() for array in found]
