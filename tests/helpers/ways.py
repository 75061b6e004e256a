# SPDX-License-Identifier: Apache-2.0
"""Exact lengths of ways around obstacles."""

import math

import numpy as np

INFLATION = 0.2


def around_corners(a, b, corners: list, radius: float) -> float:
    """Length of the shortest path from a to b that passes above rounded corners, left to right."""
    length, here, direction = 0.0, np.asarray(a, float), None
    arc = 0.0
    for corner in corners:
        away = np.asarray(corner) - here
        d = np.linalg.norm(away)
        # tangent above the circle about the corner
        heading = math.atan2(away[1], away[0])
        if direction is None:
            heading += math.asin(radius / d)
            length += math.sqrt(d * d - radius * radius)
        else:
            length += d  # between two circles of the same radius
            arc += radius * (direction - heading)
        direction, here = heading, np.asarray(corner, float)
    away = np.asarray(b) - here
    d = np.linalg.norm(away)
    heading = math.atan2(away[1], away[0]) - math.asin(radius / d)
    arc += radius * (direction - heading)
    return length + arc + math.sqrt(d * d - radius * radius)
