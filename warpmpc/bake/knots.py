# SPDX-License-Identifier: Apache-2.0
"""Source of the controls of one step: sums of few knots."""

from ..kernels.worlds.launch import TAPS

CONTROL = f"""const int* tap = (const int*)k.tap.data + (e * steps + at) * {int(TAPS)};
const float* share = (const float*)k.share.data + (e * steps + at) * {int(TAPS)};"""
"""Knots that the step's control depends on, and how much."""
