# SPDX-License-Identifier: Apache-2.0
"""Findings about bodies: what overlaps, what nothing can touch, masses, friction, roots."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...physics.model import FEW_ITERATIONS
from ...scene.model.overlaps import DEEP
from .finding import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...scene.model.at_start import Subject

HEAVIEST, LIGHTEST = 100_000.0, 1.0
"""Densities beyond which a body's mass is hardly in kilograms [kg/m³]: osmium has 22 590, air 1.2; models whose shapes
are drawn too small have up to 40 000."""
NEAR_GROUND = 0.03
"""Height up to which a link counts as standing on the ground [m]."""
HIGH_ROOT = 0.2
"""Height from which a root that is welded to the world counts as standing on legs [m]."""


def contact_findings(subject: Subject) -> Iterator[Finding]:
    """Overlaps, entities that nothing can touch, implausible densities, ice, welded roots, few solver iterations."""
    yield from _overlaps(subject)
    yield from _untouchable(subject)
    yield from _densities(subject)
    yield from _slippery(subject)
    yield from _welded(subject)
    yield from _hasty(subject)


def _hasty(subject: Subject) -> Iterator[Finding]:
    """Few solver iterations that the scene does not set."""
    count, robots = int(subject.world.model.opt.iterations), subject.compiled.mjcf_robots
    if subject.scene.engine.iterations is None and robots and count < FEW_ITERATIONS:
        yield Finding(
            "engine.iterations",
            f'the MJCF file of {robots[0].robot.name} has <option iterations="{count}">: contacts are not solved to '
            "the end, and bodies move otherwise than they should",
            f"set engine.iterations = {FEW_ITERATIONS} or more",
        )


def _overlaps(subject: Subject) -> Iterator[Finding]:
    """Links of one robot that are deep in each other at the start; two entities are refused elsewhere."""
    model, data, owner = subject.world.model, subject.start, subject.owner
    deepest: dict[tuple[str, str], float] = defaultdict(float)
    for contact in data.contact[: data.ncon]:
        first, second = sorted(int(model.geom_bodyid[g]) for g in contact.geom)
        if contact.dist < -DEEP and owner[first] == owner[second] and owner[first] >= 0:
            pair = model.body(first).name, model.body(second).name
            deepest[pair] = max(deepest[pair], -float(contact.dist))
    if deepest:
        (first, second), depth = max(deepest.items(), key=lambda item: item[1])
        more = f" (and {len(deepest) - 1} more pairs)" if len(deepest) > 1 else ""
        yield Finding(
            f"{subject.asset_key(first)}.self_collision",
            f"links {first} and {second} are {depth:.3g} m deep in each other at the start{more}: it pushes them apart",
            "change joint_q or the collision shapes, or set self_collision = false",
        )


def collides(model: mujoco.MjModel, g: int, h: int) -> bool:
    """True where MuJoCo looks for contacts of two geoms: by contype and conaffinity."""
    a, b = int(model.geom_contype[g]), int(model.geom_conaffinity[g])
    return bool(a & int(model.geom_conaffinity[h]) or b & int(model.geom_contype[h]))


def _untouchable(subject: Subject) -> Iterator[Finding]:
    """Objects that no robot can touch."""
    model, world = subject.world.model, subject.world
    explicit = {frozenset(pair) for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
    robots = [g for e in subject.compiled.layout.entities if e.kind == "robot" for g in world.geoms.get(e.name, ())]
    for entity in subject.compiled.layout.entities:
        own = world.geoms.get(entity.name, ())
        if entity.kind != "object":
            continue
        if not any(collides(model, g, h) or frozenset((g, h)) in explicit for g in own for h in robots):
            yield Finding(
                f"object.{entity.name}",
                f"no robot can touch {entity.name}: no shape of a robot collides with it",
                "give the robot's links collision shapes (contype and conaffinity in MJCF)",
            )


def _densities(subject: Subject) -> Iterator[Finding]:
    model, world = subject.world.model, subject.world
    for entity in subject.compiled.layout.entities:
        if entity.kind not in ("robot", "object"):
            continue
        bodies = [body for body in world.bodies.get(entity.name, ()) if body]
        geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
        mass = float(model.body_mass[bodies].sum())
        volume = float(np.prod(2.0 * model.geom_aabb[geoms, 3:], axis=1).sum()) if len(geoms) else 0.0
        if volume > 0.0 and mass / volume > HEAVIEST:
            yield Finding(
                f"{entity.kind}.{entity.name}",
                f"{entity.name} weighs {mass:.3g} kg in {volume:.3g} m³, more than any metal: is its mass in grams?",
                "masses are in kilograms and lengths in metres",
            )
        elif volume > 0.0 and mass / volume < LIGHTEST and entity.kind == "object":
            yield Finding(
                f"object.{entity.name}",
                f"{entity.name} weighs {mass:.3g} kg in {volume:.3g} m³, less than air: is its mass in tonnes?",
                "masses are in kilograms and lengths in metres",
            )


def _slippery(subject: Subject) -> Iterator[Finding]:
    for kind in ("object", "robot"):
        for item in getattr(subject.scene, kind):
            if item.friction == 0.0:
                yield Finding(
                    f"{kind}.{item.name}.friction",
                    f"{item.name} has no friction: nothing holds, carries or stops it",
                    "rubber on wood has about 0.8, steel on steel 0.5, ice 0.05",
                )


def _welded(subject: Subject) -> Iterator[Finding]:
    """Robots whose root is fixed in the air while several of their ends stand on the ground."""
    model, data = subject.world.model, subject.start
    if subject.scene.ground is None:
        return
    lowest = np.full(model.nbody, np.inf)
    for g in range(model.ngeom):
        corners = (
            np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * model.geom_aabb[g, 3:] + model.geom_aabb[g, :3]
        )
        if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE:
            z = corners @ data.geom_xmat[g].reshape(3, 3)[2] + data.geom_xpos[g, 2]
            lowest[model.geom_bodyid[g]] = min(lowest[model.geom_bodyid[g]], float(z.min()))
    parents = set(model.body_parentid[1:].tolist())
    for robot in subject.scene.robot:
        bodies = [body for body in subject.world.bodies.get(robot.name, ()) if body]
        moving = [body for body in bodies if model.body_jntnum[body]]
        if not moving or any(model.jnt_type[model.body_jntadr[body]] == 0 for body in moving):
            continue
        ends = [body for body in moving if not any(model.body_parentid[b] == body and b in moving for b in bodies)]
        standing = [b for b in ends if lowest[b] < subject.scene.ground.height + NEAR_GROUND]
        roots = [b for b in moving if model.body_weldid[model.body_parentid[b]] == 0]
        legs = {_root(model, end, roots) for end in standing}
        hinges = all(model.jnt_type[model.body_jntadr[body]] == 3 for body in moving)
        if len(legs) >= 2 and hinges and parents and min(float(data.xpos[b, 2]) for b in roots) > HIGH_ROOT:
            yield Finding(
                f"robot.{robot.name}.floating",
                f"the root of {robot.name} is fixed in the world although {len(legs)} legs stand on the ground: it "
                "cannot move or fall",
                "set floating = true, or give the MJCF root a freejoint",
            )


def _root(model: mujoco.MjModel, body: int, roots: list[int]) -> int:
    """The first moving body on the way from the world to a body."""
    while body not in roots and body:
        body = int(model.body_parentid[body])
    return body
