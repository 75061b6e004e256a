# SPDX-License-Identifier: Apache-2.0
"""The Newton model of all worlds of a batch: replication, randomized properties, watched pairs, capacities."""

from __future__ import annotations

from typing import TYPE_CHECKING

import newton
import numpy as np
import warp as wp
from newton import ModelFlags

from ..kernels.worlds.contacts import PairTable
from ..kernels.worlds.randomize import apply_properties_kernel
from .builder import build_world, new_builder

if TYPE_CHECKING:
    from ..engine.trajectory import Shape
    from ..scene.schema import Scene
    from .layout import Layout
    from .pairs import Pair
    from .properties import Properties

_RESIZABLE = {"box": 0, "sphere": 1, "capsule": 2, "cylinder": 3}
_CONTACTS = {frozenset(("box",)): 8, frozenset(("sphere",)): 1, frozenset(("capsule",)): 2}
"""Most contact points between two shapes of these kinds; a sphere has one with anything, others up to four."""


def build_model(scene: Scene, worlds: int, device: str) -> newton.Model:
    """Finalize a model of ``worlds`` copies of a scene.

    Raises:
        SceneError: If an asset is missing or broken, or the scene names links or joints that its asset lacks.
    """
    builder = new_builder()
    builder.replicate(build_world(scene).builder, worlds)
    return builder.finalize(device=device)


def randomize(model: newton.Model, layout: Layout, shape: Shape, properties: Properties) -> int:
    """Write every world's own mass, inertia, friction and sizes; returns what changed, as ``newton.ModelFlags``.

    Args:
        model: Model of all worlds, with nominal properties.
        layout: Layout of one world.
        shape: Sizes of the batch.
        properties: Draws of physical properties.

    Raises:
        ValueError: If there are fewer draws than the worlds need.
    """
    if not properties.names:
        return 0
    device, worlds = model.device, shape.worlds
    body_item = np.full(layout.nb, -1, dtype=np.int32)
    shape_item = np.full(len(layout.shapes), -1, dtype=np.int32)
    for i, name in enumerate(properties.names):
        entity = layout.entity(name)
        body_item[list(entity.bodies)] = i
        shape_item[list(entity.shapes)] = i
    kinds = [_RESIZABLE.get(s.kind, -1) for s in layout.shapes]

    def rows(array: wp.array, columns: int) -> wp.array:
        return array.reshape((worlds, columns))

    def nominal(array: wp.array, columns: int) -> wp.array:
        return wp.clone(rows(array, columns)[0])

    def upload(values: object, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    nb, ns = layout.nb, len(layout.shapes)
    wp.launch(
        apply_properties_kernel,
        dim=worlds,
        inputs=[
            upload(properties.of_worlds(shape), int),
            upload(properties.mass, float),
            upload(properties.friction, float),
            upload(properties.size, wp.vec3),
            upload(body_item, int),
            upload(shape_item, int),
            upload([s.body for s in layout.shapes], int),
            upload(kinds, int),
            upload([s.pose for s in layout.shapes], wp.transform),
            nominal(model.body_mass, nb),
            nominal(model.body_inertia, nb),
            nominal(model.shape_material_mu, ns),
            nominal(model.shape_scale, ns),
        ],
        outputs=[
            rows(model.body_mass, nb),
            rows(model.body_inv_mass, nb),
            rows(model.body_inertia, nb),
            rows(model.body_inv_inertia, nb),
            rows(model.shape_material_mu, ns),
            rows(model.shape_scale, ns),
        ],
        device=device,
    )
    return int(ModelFlags.BODY_INERTIAL_PROPERTIES | ModelFlags.SHAPE_PROPERTIES)


def pair_table(layout: Layout, pairs: tuple[Pair, ...], shapes: list[int], device: str) -> PairTable:
    """The watched pairs on a device.

    Args:
        layout: Layout of one world.
        pairs: Watched pairs.
        shapes: Layout shape of each shape (or geom) of the solver, -1 for none.
        device: Warp device.
    """
    names = [e.name for e in layout.entities]
    owner = {s: i for i, e in enumerate(layout.entities) for s in e.shapes}
    table = PairTable()
    table.shape_entity = wp.array([owner.get(s, -1) for s in shapes], dtype=int, device=device)
    table.first = wp.array([names.index(p.first) for p in pairs], dtype=int, device=device)
    table.second = wp.array([names.index(p.second) for p in pairs], dtype=int, device=device)
    return table


def contact_bound(model: newton.Model, layout: Layout, worlds: int) -> int:
    """Contact points one world can have at once: the sum over its shape pairs that may collide."""
    candidates = model.shape_contact_pairs.numpy()[: model.shape_contact_pair_count // worlds]
    count = len(layout.shapes)
    kinds = [s.kind for s in layout.shapes]
    total = 0
    for a, b in candidates % count:
        pair = frozenset((kinds[a], kinds[b]))
        total += 1 if "sphere" in pair else _CONTACTS.get(pair, 4)
    return total
