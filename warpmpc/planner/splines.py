# SPDX-License-Identifier: Apache-2.0
"""The kinds of spline over the knots of a plan."""

from enum import StrEnum

from warpmpc.kernels.planning import splines as kernels


class SplineKind(StrEnum):
    """Spline from knots to controls; the values are the words of scene files."""

    ZERO = "zero"
    LINEAR = "linear"
    CUBIC = "cubic"
    BSPLINE = "bspline"

    @property
    def code(self) -> int:
        """The ``kind`` argument of the kernels in ``warpmpc.kernels.planning.splines``."""
        return int(getattr(kernels, self.name))
