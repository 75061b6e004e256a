# SPDX-License-Identifier: Apache-2.0
"""Things that stand inside each other at the start, which physics would throw apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..scene.errors import SceneError

if TYPE_CHECKING:
    from ..scene.schema import Scene
    from .compiled_scene import CompiledScene

DEEP = 0.01
"""Depth from which an overlap is refused [m]: what is less settles within a few steps."""

_SHIFT = 1e-4
"""How far joints are moved for a second look [m or rad]: MuJoCo finds no contact of some shapes that are deep
in each other and exactly aligned, such as cylinders side by side."""


def deepest_overlap(
    model: mujoco.MjModel, state: np.ndarray, geoms: dict[str, tuple[int, ...]]
) -> tuple[str, str, float, tuple[str, str]] | None:
    """The two things of a scene that overlap most, how deep [m], and their bodies; None where nothing touches.

    Args:
        model: The scene's model.
        state: Full physics state of the start, in MuJoCo's order.
        geoms: Geoms of each thing; those of one thing may overlap each other.
    """
    owner = {geom: name for name, own in geoms.items() for geom in own}
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, np.asarray(state, dtype=float), mujoco.mjtState.mjSTATE_FULLPHYSICS)
    found = []
    for shift in (0.0, _SHIFT):
        mujoco.mj_integratePos(model, data.qpos, np.random.default_rng(0).uniform(-1.0, 1.0, model.nv), shift)
        mujoco.mj_forward(model, data)
        for contact in data.contact[: data.ncon]:
            first, second = (owner.get(int(geom)) for geom in contact.geom)
            if first is not None and second is not None and first != second:
                bodies = tuple(model.body(int(model.geom_bodyid[geom])).name for geom in contact.geom)
                found.append((-float(contact.dist), first, second, bodies))
    if not found:
        return None
    depth, first, second, bodies = max(found)
    return first, second, depth, bodies


def refuse_overlap(
    scene: Scene, compiled: CompiledScene, model: mujoco.MjModel, state: np.ndarray, *, grown: float = 0.0
) -> None:
    """Refuse a start at which two things stand deep inside each other.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        model: A MuJoCo model of it.
        state: Full physics state of the start, in MuJoCo's order.
        grown: Growth by drawn sizes [m], by which things may be deeper in what they stand on.

    Raises:
        SceneError: If they do: which ones and how deep.
    """
    geoms = {
        entity.name: tuple(model.geom(name).id for shape in entity.shapes if (name := compiled.geom_name[shape]))
        for entity in compiled.layout.entities
    }
    found = deepest_overlap(model, state, geoms)
    if found is None or found[2] < DEEP + grown:
        return
    *both, depth, bodies = found
    keys = {item.name: kind for kind in ("obstacle", "object", "robot") for item in getattr(scene, kind)}
    other, moved = sorted(both, key=lambda name: list(keys).index(name) if name in keys else -1)
    cure = "position or joint_q" if keys[moved] == "robot" else "position"
    names = dict(zip(compiled.body_name, compiled.layout.body_name, strict=True))
    links = " and ".join(name for body in bodies if "/" in (name := names.get(body, "")))
    where = f" (link {links})" if links else ""
    raise SceneError(
        f"'{moved}' and '{other}' overlap by {depth:.3g} m at the start{where}: change the {cure}",
        key=f"{keys[moved]}.{moved}",
        file=scene.path,
    )
