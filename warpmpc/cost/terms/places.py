# SPDX-License-Identifier: Apache-2.0
"""Places that residuals are about: frames, centres of mass, and their means, as points of bodies with shares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import warp as wp
from pydantic import Field

from ...kernels.cost.points import Points
from ...scene.model.layout import WORLD
from ...scene.types import OneOrSeveral, Section

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ...scene.model.layout import Layout
    from ..binding import Binding


class CentreOfMass(Section):
    """A place that no frame marks."""

    centre_of_mass: str
    """Robot, object, or ``robot/link`` with all that hangs on it."""


Place = Annotated[tuple[str | CentreOfMass, ...], Field(min_length=1), OneOrSeveral]
"""A frame, or ``{ centre_of_mass = "robot" }``; of several the mean."""


class Point(NamedTuple):
    """A point of a body."""

    body: int
    at: tuple[float, ...]
    """In the body's frame [m]."""
    share: float
    lead: float = 0.0
    """Moved on by its velocity for this time [s]."""

    def scaled(self, factor: float, lead: float = 0.0) -> Point:
        """The same point with another share."""
        return self._replace(share=factor * self.share, lead=lead)


def place_points(place: Sequence[str | CentreOfMass], key: str, b: Binding) -> list[Point]:
    """The points whose sum is a place: the mean of frames and centres of mass."""
    points = []
    for part in place:
        if isinstance(part, CentreOfMass):
            bodies = massive(part.centre_of_mass, f"{key}.centre_of_mass", b)
            mass = b.layout.body_mass[bodies].astype(float)
            shares = zip(bodies, mass / mass.sum(), strict=True)
            points += [Point(int(body), tuple(b.layout.body_com[body].tolist()), float(m)) for body, m in shares]
        else:
            frame = b.frame(part, key)
            points.append(Point(int(b.layout.frame_body[frame]), tuple(b.layout.frame_pose[frame, :3].tolist()), 1.0))
    return [point.scaled(1.0 / len(place)) for point in points]


def massive(name: str, key: str, b: Binding) -> np.ndarray:
    """Bodies with mass of a robot or an object, or of a link and all that hangs on it."""
    layout = b.layout
    entities = {entity.name: entity for entity in layout.entities if entity.kind in ("robot", "object")}
    if name in entities:
        bodies = list(entities[name].bodies)
    else:
        links = [frame for frame in layout.frame_name if frame.partition("/")[0] in entities]
        if name not in links:
            raise b.error("no such robot, object or link", key, found=name, allowed=[*entities, *links])
        bodies = hanging(layout, int(layout.frame_body[layout.frame_name.index(name)]))
    found = np.array([body for body in bodies if layout.body_mass[body] > 0.0], dtype=int)
    if not len(found):
        raise b.error("this has no mass", key, found=name)
    return found


def hanging(layout: Layout, body: int) -> list[int]:
    """A body and all that joints hang on it; nothing for the world."""
    if body <= WORLD:
        return []
    found = [body]
    for child, parent in zip(layout.joint_child.tolist(), layout.joint_parent.tolist(), strict=True):
        if parent in found:  # parents come before children
            found.append(child)
    return found


def points_struct(points: Sequence[Point], b: Binding) -> Points:
    """Points as kernels take them."""
    out = Points()
    out.body = b.array([point.body for point in points], dtype=int)
    out.at = b.array([point.at for point in points], dtype=wp.vec3)
    out.share = b.array([point.share for point in points], dtype=float)
    out.lead = b.array([point.lead for point in points], dtype=float)
    return out
