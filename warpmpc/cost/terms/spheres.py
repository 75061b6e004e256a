# SPDX-License-Identifier: Apache-2.0
"""Spheres that cover links, as collision terms take them."""

from collections.abc import Sequence
from enum import StrEnum
from typing import Any

import warp as wp

from ...scene.errors import SceneError
from ...scene.model.layout import Entity
from ...scene.model.pairs import moving_bodies
from ...scene.model.spheres import Spheres, fit_spheres
from ...scene.types import Names, NonNegative, Positive
from ..binding import Binding
from ..keys import TermKeys


@wp.struct
class SphereTable:
    """Spheres of links, in groups of one body each."""

    centre: wp.array[wp.vec3]  # [n] in the body's frame [m]
    radius: wp.array[float]  # [n] [m]
    body: wp.array[int]  # [groups]
    first: wp.array[int]  # [groups] first sphere
    count: wp.array[int]  # [groups]
    bound_centre: wp.array[wp.vec3]  # [groups] of a sphere around the group's, in the body's frame [m]
    bound_radius: wp.array[float]  # [groups] [m]


def link_body(name: str, bodies: Sequence[int], b: Binding, key: str) -> int:
    """Body of a link, by ``robot/link`` or the link's own name where unique."""
    full = {b.layout.body_name[body]: body for body in bodies}
    found = [body for label, body in full.items() if name in (label, label.partition("/")[2])]
    if len(found) != 1:
        what = "several links have this name" if found else "no such link"
        raise SceneError(what, key=key, file=b.file, found=name, allowed=full)
    return found[0]


def fitted(robots: Sequence[Entity], bodies: Sequence[int], overhang: float, b: Binding) -> Spheres:
    """Spheres of some bodies: the scene's own where it has them, else fitted ones."""
    given = {}
    for robot in robots:
        for name, rows in next(r for r in b.scene.robot if r.name == robot.name).spheres.items():
            given[link_body(name, robot.bodies, b, f"robot.{robot.name}.spheres.{name}")] = rows
    spheres = fit_spheres(b.layout, bodies, overhang=overhang, given=given)
    if not len(spheres):
        raise b.error(
            f"these links have no shape that collides: give them spheres = {{ link = [[x, y, z, radius]] }} in "
            f"[[robot]] '{robots[0].name}'",
            found=[b.layout.body_name[body] for body in bodies],
        )
    return spheres


def table_of(spheres: Spheres, b: Binding) -> SphereTable:
    """Spheres as kernels take them."""
    groups = spheres.groups
    table = SphereTable()
    table.centre, table.radius = b.array(spheres.centre, wp.vec3), b.array(spheres.radius, float)
    for name in ("body", "first", "count"):
        setattr(table, name, b.array([getattr(group, name) for group in groups], int))
    table.bound_centre = b.array([group.centre for group in groups], wp.vec3)
    table.bound_radius = b.array([group.radius for group in groups], float)
    return table


class CollisionForm(StrEnum):
    """Form of the cost of a collision."""

    DISTANCE = "distance"
    BINARY = "binary"


class LinkKeys(TermKeys):
    """Links of a robot, as spheres, and the cost of what is near them."""

    of: str | None = None
    """Robot; all robots when left out."""
    links: Names | None = None
    """Links, ``robot/link`` or the link's own name; all that joints move when left out."""
    form: CollisionForm = CollisionForm.DISTANCE
    """distance: max(0, margin - d); binary: 1 if d < margin, else 0."""
    margin: NonNegative = 0.0
    """Distances below this cost something [m]."""
    overhang: Positive = 0.03
    """How far the spheres may stick out of the links [m]: less takes more spheres."""

    derived = {"spheres": SphereTable, "binary": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the spheres of the links."""
        robots = b.robots(self.of)
        own = [body for robot in robots for body in robot.bodies]
        moving = moving_bodies(b.layout)
        bodies = [body for body in own if body in moving]
        if self.links is not None:
            bodies = [link_body(name, own, b, f"{b.key}.links") for name in self.links]
        p.spheres = table_of(fitted(robots, bodies, self.overhang, b), b)
        p.binary = int(self.form is CollisionForm.BINARY)
