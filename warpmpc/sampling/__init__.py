# SPDX-License-Identifier: Apache-2.0
"""Noise sources, shaping matrices and spline kinds: what a plan step needs built once, on the host."""

from .noise import NoiseKind, NoiseSource
from .shaping import bspline, coloured, comb, identity
from .splines import SplineKind

__all__ = ["NoiseKind", "NoiseSource", "SplineKind", "bspline", "coloured", "comb", "identity"]
