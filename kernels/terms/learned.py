# SPDX-License-Identifier: Apache-2.0
"""Learned collision costs: small networks in place of geometry."""

import warp as wp

from .view import StepView, joint_position

wp.set_module_options({"enable_backward": False})

UNITS = wp.constant(64)
"""Most inputs, and most units of the second row, of a network."""

Units = wp.types.vector(length=UNITS, dtype=float)


@wp.struct
class LearnedSelfCollisionParams:
    """Parameters of ``learned_self_collision``: a network [sin q, cos q] → H → U → 1."""

    coord: wp.array[int]  # [n] joint coordinates
    first: wp.array2d[float]  # [H, 2n + 1] weights of sin q, of cos q, and the bias
    second: wp.array2d[float]  # [H + 1, U], the last row the biases
    last: wp.array[float]  # [U + 1], the last one the bias
    margin: float  # [m]


@wp.func
def network_distance(s: StepView, p: LearnedSelfCollisionParams) -> float:
    """Output of the network for a configuration, positive where links penetrate [m]."""
    joints = p.coord.shape[0]
    inputs = Units()
    for i in range(joints):
        q = joint_position(s, p.coord[i])
        inputs[i] = wp.sin(q)
        inputs[joints + i] = wp.cos(q)
    rows = p.first.shape[0]
    units = p.second.shape[1]
    sums = Units()
    for u in range(units):
        sums[u] = p.second[rows, u]
    for h in range(rows):
        x = p.first[h, 2 * joints]
        for i in range(2 * joints):
            x += p.first[h, i] * inputs[i]
        x = wp.clamp(x, 0.0, 6.0)
        for u in range(units):
            sums[u] += x * p.second[h, u]
    d = p.last[units]
    for u in range(units):
        d += p.last[u] * wp.clamp(sums[u], 0.0, 6.0)
    return d


@wp.func
def learned_self_collision(s: StepView, p: LearnedSelfCollisionParams) -> float:
    """max(0, margin + d) with d a network's guess of how deep two links are in each other [m].

    The self-collision cost of Bhardwaj et al. 2021: positional encoding, two hidden rows, ReLU6.
    """
    return wp.max(0.0, p.margin + network_distance(s, p))
