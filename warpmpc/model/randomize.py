# SPDX-License-Identifier: Apache-2.0
"""Physical properties of a draw put into models: mass, friction and sizes, with the inertia that follows from them.

What a draw does to a shape and to its inertia is said once, over any number of draws; MuJoCo models, the batched
arrays of MuJoCo Warp and the arrays of a Newton model are filled from it.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from .mujoco_model import average_friction
from .properties import RESIZABLE

if TYPE_CHECKING:
    import newton

    from .batch_size import BatchSize
    from .layout import Layout
    from .mujoco_model import MujocoWorld
    from .properties import Properties

_KINDS = {
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
}
"""Geoms whose size may vary, those of :data:`RESIZABLE`."""
LEAST_SIZE = 0.1
"""No dimension shrinks below this share of its nominal value."""


def resized(kind: str, size: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """A primitive's size with an offset added to its dimensions.

    Args:
        kind: ``box``, ``ellipsoid``, ``sphere``, ``capsule`` or ``cylinder``.
        size: Half extents, or radius and half length, ``[..., 3]`` [m].
        offset: What is added to its full extents, or to its radius and length, ``[..., 3]`` [m].
    """
    full = {"box": (0.5, 0.5, 0.5), "ellipsoid": (0.5, 0.5, 0.5), "sphere": (1.0,)}.get(kind, (1.0, 0.5))
    size, offset = np.broadcast_arrays(size, offset)
    new, n = np.array(size, dtype=float), len(full)
    new[..., :n] = np.maximum(size[..., :n] + offset[..., :n] * full, LEAST_SIZE * size[..., :n])
    return new


def unit_inertia(kind: str, size: np.ndarray) -> np.ndarray:
    """Principal inertia per mass of a solid primitive about its own axes ``[..., 3]`` [m²].

    Args:
        kind: As in :func:`resized`.
        size: Half extents, or radius and half length, ``[..., 3]`` [m].
    """
    x, y, z = np.moveaxis(np.asarray(size, dtype=float), -1, 0)
    match kind:
        case "box":
            moments = [(y * y + z * z) / 3.0, (x * x + z * z) / 3.0, (x * x + y * y) / 3.0]
        case "ellipsoid":
            moments = [(y * y + z * z) / 5.0, (x * x + z * z) / 5.0, (x * x + y * y) / 5.0]
        case "sphere":
            moments = [0.4 * x * x] * 3
        case "capsule":
            length = 2.0 * y
            caps = 4.0 * x / (4.0 * x + 3.0 * length)  # share of the mass
            across = (1.0 - caps) * (3.0 * x * x + length * length) / 12.0
            across = across + caps * (0.4 * x * x + length * (3.0 * x + 2.0 * length) / 8.0)
            moments = [across, across, (0.5 * (1.0 - caps) + 0.4 * caps) * x * x]
        case _:
            across = x * x / 4.0 + y * y / 3.0
            moments = [across, across, x * x / 2.0]
    return np.stack(moments, axis=-1)


def bounds(kind: str, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half extents of a primitive's box ``[..., 3]`` and radius of its sphere ``[...]`` [m]."""
    x, y, _ = np.moveaxis(size, -1, 0)
    match kind:
        case "box":
            return size, np.linalg.norm(size, axis=-1)
        case "ellipsoid":
            return size, size.max(axis=-1)
        case "sphere":
            return np.stack([x, x, x], axis=-1), x
        case "capsule":
            return np.stack([x, x, x + y], axis=-1), x + y
        case _:
            return np.stack([x, x, y], axis=-1), np.hypot(x, y)


def randomized_arrays(world: MujocoWorld, properties: Properties, draws: np.ndarray) -> dict[str, np.ndarray]:
    """Arrays of a MuJoCo model that draws change, ``[N, ...]`` each, in float64.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        draws: Which of them ``[N]``.
    """
    names = ("body_mass", "body_inertia", "geom_friction", "geom_size", "geom_aabb", "geom_rbound", "pair_friction")
    model = world.model
    out = {name: np.repeat(getattr(model, name)[None], len(draws), axis=0) for name in names}
    for i, name in enumerate(properties.names):
        mass, friction = properties.mass[draws, i], properties.friction[draws, i]
        for body in world.bodies[name]:
            out["body_mass"][:, body] *= mass
            out["body_inertia"][:, body] *= mass[:, None]
        for geom in world.geoms[name]:
            out["geom_friction"][:, geom, 0] *= friction
            _resize(model, geom, properties.size[draws, i], out)
    for pair in world.averaged:
        geoms = model.pair_geom1[pair], model.pair_geom2[pair]
        out["pair_friction"][:, pair] = average_friction(out["geom_friction"], *geoms)
    return out


def _resize(model: mujoco.MjModel, geom: int, offset: np.ndarray, out: dict[str, np.ndarray]) -> None:
    """Add offsets [N, 3] to a primitive's dimensions [m] and scale its body's inertia accordingly."""
    kind = _KINDS.get(mujoco.mjtGeom(int(model.geom_type[geom])))  # numpy integers do not hash like the enum
    if kind is None or not offset.any():
        return
    old = model.geom_size[geom]
    new = resized(kind, old, offset)
    out["geom_size"][:, geom] = new
    ratio = unit_inertia(kind, new) / unit_inertia(kind, old)
    body = model.geom_bodyid[geom]
    if body:
        out["body_inertia"][:, body] *= ratio[:, _axis_order(model, body)]
    out["geom_aabb"][:, geom, 3:], out["geom_rbound"][:, geom] = bounds(kind, new)


def _axis_order(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Geometry axis that each principal axis of a body's inertia lies along."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
    return np.argmax(np.abs(rotation.reshape(3, 3)), axis=0)


def randomize_model(world: MujocoWorld, properties: Properties, draw: int) -> mujoco.MjModel:
    """A copy of the model with the properties of one draw; inertia follows mass and size.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        draw: Which of them.
    """
    model = copy.copy(world.model)
    if properties.names:
        for name, values in randomized_arrays(world, properties, np.array([draw])).items():
            getattr(model, name)[:] = values[0]
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


_CONSTANTS = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "tendon_invweight0",
    "actuator_acc0",
)
"""Arrays that MuJoCo derives from masses and inertias."""


def batched_arrays(world: MujocoWorld, properties: Properties, shape: BatchSize) -> dict[str, np.ndarray]:
    """Arrays of a MuJoCo model that differ between worlds, ``[W, ...]`` each.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        shape: Sizes of the batch.

    Raises:
        ValueError: If there are fewer draws than the worlds need.
    """
    draws, row = np.unique(properties.of_worlds(shape), return_inverse=True)
    out = randomized_arrays(world, properties, draws)
    model = copy.copy(world.model)
    data = mujoco.MjData(model)
    constants: dict[str, list[np.ndarray]] = {name: [] for name in _CONSTANTS}
    for n in range(len(draws)):
        for name, values in out.items():
            getattr(model, name)[:] = values[n]
        mujoco.mj_setConst(model, data)
        for name, rows in constants.items():
            rows.append(getattr(model, name).copy())
    every = {**out, **{name: np.array(rows) for name, rows in constants.items()}}
    return {name: values[row] for name, values in every.items() if np.ptp(values, axis=0).any()}


def randomize_newton(model: newton.Model, layout: Layout, shape: BatchSize, properties: Properties) -> int:
    """Write every world's own mass, inertia, friction and sizes; returns what changed, as ``newton.ModelFlags``.

    Args:
        model: Model of all worlds, with nominal properties.
        layout: Layout of one world.
        shape: Sizes of the batch.
        properties: Draws of physical properties.

    Raises:
        ValueError: If there are fewer draws than the worlds need.
    """
    from newton import ModelFlags

    if not properties.names:
        return 0
    draws = properties.of_worlds(shape)

    def rows(name: str, *size: int) -> np.ndarray:
        return getattr(model, name).numpy().reshape(shape.worlds, -1, *size).astype(float)

    mass, inertia = rows("body_mass"), rows("body_inertia", 3, 3)
    friction, size = rows("shape_material_mu"), rows("shape_scale", 3)
    for i, name in enumerate(properties.names):
        entity, factor = layout.entity(name), properties.mass[draws, i]
        for body in entity.bodies:
            mass[:, body] *= factor
            inertia[:, body] *= factor[:, None, None]
        for s in entity.shapes:
            info = layout.shapes[s]
            friction[:, s] *= properties.friction[draws, i]
            if info.kind not in RESIZABLE:
                continue
            old = size[:, s].copy()
            size[:, s] = new = resized(info.kind, old, properties.size[draws, i])
            if info.body >= 0:
                # the ratio of new to old holds along the shape's own axes
                ratio = np.sqrt(unit_inertia(info.kind, new) / unit_inertia(info.kind, old))
                axes = Rotation.from_quat(info.pose[3:]).as_matrix()
                local = axes.T @ inertia[:, info.body] @ axes * ratio[:, :, None] * ratio[:, None, :]
                inertia[:, info.body] = axes @ local @ axes.T
    heavy = mass > 0.0
    written = {
        "body_mass": mass,
        "body_inertia": inertia,
        "body_inv_mass": np.where(heavy, 1.0 / np.where(heavy, mass, 1.0), 0.0),
        "body_inv_inertia": np.where(
            heavy[..., None, None], np.linalg.inv(np.where(heavy[..., None, None], inertia, np.eye(3))), 0.0
        ),
        "shape_material_mu": friction,
        "shape_scale": size,
    }
    for name, values in written.items():
        array = getattr(model, name)
        array.assign(values.reshape(array.numpy().shape).astype(np.float32))
    return int(ModelFlags.BODY_INERTIAL_PROPERTIES | ModelFlags.SHAPE_PROPERTIES)
