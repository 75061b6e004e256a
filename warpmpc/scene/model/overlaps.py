# SPDX-License-Identifier: Apache-2.0
"""Things that stand inside each other at the start, which physics would throw apart.

Checks of what an asset may not say, although it can be read: numbers that are none, limits the wrong way round.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..errors import SceneError

if TYPE_CHECKING:
    from ..schema import Scene
    from .compiled_scene import CompiledScene
    from .layout import Layout

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


def validate_layout(layout: Layout, scene: Scene) -> None:
    """Refuse a layout no state can be planned from.

    Raises:
        SceneError: If a number in it is not finite, or the lower limit of a joint lies above the upper one.
    """
    places = layout.joint_pose_parent, layout.joint_pose_child
    for j, name in enumerate(layout.joint_name):
        first_q, first_v = int(layout.joint_q_start[j]), int(layout.joint_qd_start[j])
        dofs = slice(first_v, first_v + int(layout.joint_dof_dim[j].sum()))
        end = int(layout.joint_q_start[j + 1]) if j + 1 < len(layout.joint_q_start) else layout.nq
        for what, values in (
            ("start", layout.joint_q[first_q:end]),
            ("start velocity", layout.joint_qd[dofs]),
            ("place", np.array([place[j] for place in places])),
        ):
            if not np.isfinite(values).all():
                raise _invalid(f"the {what} of joint '{name}' is not finite", name, scene)
        if np.isnan(layout.dof_lower[dofs]).any() or np.isnan(layout.dof_upper[dofs]).any():
            raise _invalid(f"a limit of joint '{name}' is no number", name, scene)
        if np.any(layout.dof_lower[dofs] > layout.dof_upper[dofs]):
            raise _invalid(f"the lower limit of joint '{name}' is above its upper one", name, scene)
    for name, centre in zip(layout.body_name, layout.body_com, strict=True):
        if not np.isfinite(centre).all():
            raise _invalid(f"the centre of mass of '{name}' is not finite", name, scene)


def _invalid(message: str, name: str, scene: Scene) -> SceneError:
    """The error for a joint or body, by the robot that its name begins with."""
    owner = next((r for r in scene.robot if name.startswith(f"{r.name}/")), scene.robot[0])
    return SceneError(message, key=f"robot.{owner.name}.asset", file=scene.path, found=owner.asset)
