# SPDX-License-Identifier: Apache-2.0
"""The types of point clouds in a scene, and of the camera that shows one to a simulated plant."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, model_validator

from .types import Count, Finite, Name, NonNegative, Positive, Section, TwoOrMore, Vec3

LONGEST = 1024
"""Voxels along an axis at most."""
DEEPEST = 100
"""Voxels in the reach at most."""


class Camera(Section):
    """A depth camera that stands still and looks at the plant's world."""

    position: Vec3
    """Where it is [m]."""
    look_at: Vec3
    """A point in the middle of the picture [m]."""
    width: TwoOrMore = 250
    """Pixels."""
    height: TwoOrMore = 200
    """Pixels."""
    fov: Annotated[float, Field(strict=True, gt=0.0, lt=170.0)] = 60.0
    """Height of the picture as an angle [degrees]."""
    far: Positive = 3.0
    """Nothing farther is seen [m]."""
    rate: Positive = 30.0
    """Pictures per second [1/s]."""
    noise: NonNegative = 0.0
    """Standard deviation of the depth [m]."""

    @model_validator(mode="after")
    def _looks_somewhere(self) -> Camera:
        if self.position[:2] == self.look_at[:2]:
            raise ValueError("a camera that looks straight up or down has no upright picture: move it a little")
        return self


class Cloud(Section):
    """Points [n, 3] that something sees and that may change at every plan: ``task["name"] = points``."""

    name: Name
    """What cost terms and ``task[...]`` call it."""
    low: Vec3
    """Lowest corner of the region in which points count [m]."""
    high: Vec3
    """Its highest corner [m]."""
    voxel: Positive = 0.025
    """Edge of the voxels [m]."""
    reach: Positive = 0.15
    """Distances are known up to this [m]: no less than a link's radius and a term's margin."""
    capacity: Count = 50000
    """Points at most."""
    eye: Vec3 | None = None
    """Where the points are seen from [m]; the camera's position when left out."""
    behind: NonNegative = 0.0
    """So far behind a point, as the eye sees it, counts as filled [m]: a picture shows front sides alone."""
    camera: Camera | None = None
    """Camera with which simulated plants fill the cloud; without it whoever plans does."""

    @property
    def size(self) -> tuple[int, int, int]:
        """Voxels along x, y, z that cover the region."""
        return tuple(max(math.ceil((b - a) / self.voxel - 1e-6), 2) for a, b in zip(self.low, self.high, strict=True))

    @property
    def seen_from(self) -> tuple[Finite, Finite, Finite] | None:
        """Place that the points are seen from [m]."""
        return self.eye or (self.camera.position if self.camera else None)

    @model_validator(mode="after")
    def _fits(self) -> Cloud:
        if any(a >= b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError("a cloud's region needs low = [x, y, z] below high = [x, y, z]")
        if max(self.size) > LONGEST:
            raise ValueError(f"a region of {self.size} voxels: at most {LONGEST} along an axis, take a larger voxel")
        if self.reach > DEEPEST * self.voxel:
            raise ValueError(f"a reach is {DEEPEST} voxels at most: take a larger voxel or a shorter reach")
        if self.behind and self.seen_from is None:
            raise ValueError("behind needs to know where the points are seen from: give eye = [x, y, z] or a camera")
        if self.camera and self.camera.width * self.camera.height > self.capacity:
            raise ValueError("the camera has more pixels than the cloud has capacity")
        return self
