# SPDX-License-Identifier: Apache-2.0
"""Physical properties of a draw put into models: mass, friction and sizes, with the inertia that follows from them.

The numbers of a drawn model are made in one place (:class:`~warpmpc.model.drawn_model.DrawnModel`); MuJoCo models, the
batched arrays of MuJoCo Warp and the arrays of a Newton model are filled from it.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from .drawn_model import DrawnModel
from .properties import RESIZABLE

if TYPE_CHECKING:
    import newton

    from .batch_size import BatchSize
    from .layout import Layout
    from .mujoco_model import MujocoWorld
    from .properties import Properties


def randomized_arrays(world: MujocoWorld, properties: Properties) -> dict[str, np.ndarray]:
    """Arrays of a MuJoCo model that draws change, ``[N, ...]`` each, in float64.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
    """
    return DrawnModel(world, properties).arrays()


def randomized_models(world: MujocoWorld, properties: Properties) -> list[mujoco.MjModel]:
    """A copy of the model for every draw, with its properties; inertia follows mass and size.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
    """
    arrays, data, out = randomized_arrays(world, properties), mujoco.MjData(world.model), []
    for n in range(properties.draws):
        model = copy.copy(world.model)
        for name, values in arrays.items():
            getattr(model, name)[:] = values[n]
        mujoco.mj_setConst(model, data)
        out.append(model)
    return out


def batched_arrays(world: MujocoWorld, properties: Properties, shape: BatchSize) -> dict[str, np.ndarray]:
    """Arrays of a MuJoCo model that differ between worlds, ``[W, ...]`` each.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        shape: Sizes of the batch.

    Raises:
        ValueError: If there are fewer draws than the worlds need.
    """
    draws = properties.of_worlds(shape)
    arrays = randomized_arrays(world, properties).items()
    every = {name: values[draws] for name, values in arrays}
    return {name: values for name, values in every.items() if np.ptp(values, axis=0).any()}


def randomize_newton(
    model: newton.Model, layout: Layout, shape: BatchSize, properties: Properties, world: MujocoWorld
) -> int:
    """Write every world's own mass, inertia, friction and sizes; returns what changed, as ``newton.ModelFlags``.

    Args:
        model: Model of all worlds, with nominal properties.
        layout: Layout of one world.
        shape: Sizes of the batch.
        properties: Draws of physical properties.
        world: The nominal model, as MuJoCo's.

    Raises:
        ValueError: If there are fewer draws than the worlds need.
    """
    from newton import ModelFlags

    if not properties.names:
        return 0
    draws = properties.of_worlds(shape)
    drawn = {name: values[draws] for name, values in randomized_arrays(world, properties).items()}

    def rows(name: str, *size: int) -> np.ndarray:
        return getattr(model, name).numpy().reshape(shape.worlds, -1, *size).astype(float)

    mass, inertia = rows("body_mass"), rows("body_inertia", 3, 3)
    friction, size = rows("shape_material_mu"), rows("shape_scale", 3)
    for i, name in enumerate(properties.names):
        entity, factor = layout.entity(name), properties.mass[draws, i]
        for body, there in zip(entity.bodies, world.bodies[name], strict=True):
            mass[:, body] *= factor
            inertia[:, body] *= factor[:, None, None]
            if properties.sized[i]:
                quaternion = world.model.body_iquat[there]
                axes = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
                inertia[:, body] = np.einsum("ik,wk,jk->wij", axes, drawn["body_inertia"][:, there], axes)
        for s in entity.shapes:
            friction[:, s] *= properties.friction[draws, i]
        if properties.sized[i]:
            shapes = [s for s in entity.shapes if layout.shapes[s].collides]
            for s, geom in zip(shapes, world.geoms[name], strict=True):
                if layout.shapes[s].kind in RESIZABLE:
                    size[:, s] = drawn["geom_size"][:, geom]
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
