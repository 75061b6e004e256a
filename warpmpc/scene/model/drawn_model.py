# SPDX-License-Identifier: Apache-2.0
"""Numbers of a MuJoCo model that draws of physical properties change, made by kernels on the device of the worlds.

Physical properties of a draw put into models: mass, friction and sizes, with the inertia that follows from them.

The numbers of a drawn model are made in one place (:class:`~warpmpc.scene.model.drawn_model.DrawnModel`); MuJoCo
models, the batched arrays of MuJoCo Warp and the arrays of a Newton model are filled from it.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from ...kernels.engine import randomize as kernels
from ...kernels.engine.randomize import (
    Draws,
    ModelTables,
    WeightTables,
    apply_kernel,
    count_kernel,
    draw_kernel,
    weigh_kernel,
)
from ...physics.runtime.launch import Launcher, capturing
from .mujoco_model import axis_order
from .properties import RESIZABLE

if TYPE_CHECKING:
    import newton

    from .layout import Layout
    from .mujoco_model import MujocoWorld
    from .properties import Properties
    from .trajectory import BatchSize

ARRAYS = (
    *("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0"),
    *("actuator_acc0", "geom_friction", "geom_size", "geom_aabb", "geom_rbound", "pair_friction", "dof_damping"),
)
"""Arrays of a model that draws change."""
_KINDS = {
    mujoco.mjtGeom.mjGEOM_BOX: kernels.BOX,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: kernels.ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_SPHERE: kernels.SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE: kernels.CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER: kernels.CYLINDER,
}
"""Geoms whose size may vary, those of ``properties.RESIZABLE``."""

_MUSCLE = mujoco.mjtGain.mjGAIN_MUSCLE


class DrawnModel:
    """Numbers of a model, one row per draw ``[N, numbers]``: its arrays one after the other, flat.

    Args:
        world: The nominal model.
        properties: Draws of physical properties.
        device: Warp device.
    """

    values: wp.array2d
    """The numbers."""
    place: dict[str, slice]
    """Numbers of each of :data:`ARRAYS` in a row."""

    def __init__(self, world: MujocoWorld, properties: Properties, device: str = "cpu"):
        self.model, self.device, self.draws = world.model, device, properties.draws
        self._launch, self._properties = Launcher(device), properties
        sizes = [getattr(world.model, name).size for name in ARRAYS]
        ends = np.cumsum([0, *sizes]).tolist()
        self.place = {name: slice(*ends[i : i + 2]) for i, name in enumerate(ARRAYS)}
        self.nominal = np.concatenate([np.ravel(getattr(world.model, name)) for name in ARRAYS])
        with capturing:
            self._tables = self._model_tables(world, properties)
            self._weights = self._weight_tables([int(row[0]) for row in self._tables.bodies.numpy()])
            self.values = self._array(np.tile(self.nominal, (self.draws, 1)), wp.float64)
            self._out = Draws()
            for name in ("mass", "friction", "size"):
                setattr(self._out, name, self._array(getattr(properties, name), wp.float64))
            n = self._weights.matrix.shape[0]
            self._factor = wp.zeros((self.draws, n, n), dtype=wp.float64, device=device)
            self._solution = wp.zeros((self.draws, n), dtype=wp.float64, device=device)
            if properties.redrawn:
                self._rules = properties.rules.on(device)
                self._first = wp.zeros(1, dtype=int, device=device)
        self.apply()

    def redraw(self) -> None:
        """Draw anew what is drawn in every plan, and put it into :attr:`values`; capture-safe."""
        self._launch(draw_kernel, self._properties.mass.shape, [self._rules, self._first], [self._out])
        self._launch(count_kernel, 1, [self.draws], [self._first])
        self.apply()

    def reset(self) -> None:
        """Begin with the first draws again."""
        self._first.zero_()

    def apply(self) -> None:
        """Put the draws into :attr:`values`; capture-safe."""
        self._launch(apply_kernel, self.draws, [self._tables, self._out], [self.values])
        if self._weights.matrix.size:
            outputs = [self._factor, self._solution, self.values]
            self._launch(weigh_kernel, self.draws, [self._tables.nominal, self._weights], outputs)

    def arrays(self, values: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Arrays of rows of numbers, by default :attr:`values`, ``[N, ...]`` each, in float64."""
        rows = self.values.numpy() if values is None else values
        return {
            name: rows[:, at].reshape(len(rows), *getattr(self.model, name).shape) for name, at in self.place.items()
        }

    def _array(self, values: object, dtype: type = int) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.device)

    def _table(self, rows: list[tuple[int, ...]], width: int) -> wp.array:
        return self._array(np.array(rows, dtype=np.int32).reshape(-1, width))

    def _model_tables(self, world: MujocoWorld, properties: Properties) -> ModelTables:
        m, out = self.model, ModelTables()
        for name in ("body_mass", "body_inertia", "body_subtreemass"):
            setattr(out, name, self.place[name].start)
        for name in ("geom_friction", "geom_size", "geom_aabb", "geom_rbound", "pair_friction"):
            setattr(out, name, self.place[name].start)
        out.nominal, out.body_parent = self._array(self.nominal, wp.float64), self._array(m.body_parentid)
        bodies, geoms = [], []
        sized = properties.sized
        for i, name in enumerate(properties.names):
            bodies += [(body, i) for body in world.bodies[name]]
            for geom in world.geoms[name]:
                # numpy integers do not hash like the enum
                kind = _KINDS.get(mujoco.mjtGeom(int(m.geom_type[geom])), 0) if sized[i] else 0
                geoms.append((geom, i, int(kind), int(m.geom_bodyid[geom])))
        out.bodies, out.geoms = self._table(bodies, 2), self._table(geoms, 4)
        out.axes = self._table([axis_order(m, body) for body in range(m.nbody)], 3)
        pairs = [(int(p), int(m.pair_geom1[p]), int(m.pair_geom2[p])) for p in world.averaged]
        out.pairs = self._table(pairs, 3)
        damped = []
        for body in world.damped:
            dof = self.place["dof_damping"].start + int(m.body_dofadr[body])
            inertia = out.body_inertia + 3 * body
            damped += [(dof + k, out.body_mass + body) for k in range(3)]
            damped += [(dof + 3 + int(axis), inertia + k) for k, axis in enumerate(axis_order(m, body))]
        out.damped = self._table(damped, 2)
        return out

    def _weight_tables(self, bodies: list[int]) -> WeightTables:
        """Tables of the trees that some bodies belong to, with everything that MuJoCo weighs there."""
        m, out = self.model, WeightTables()
        data = mujoco.MjData(m)
        mujoco.mj_resetData(m, data)
        mujoco.mj_fwdPosition(m, data)
        full = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, data, full)
        turned = {body: _jacobian(m, data, body) for body in range(1, m.nbody)}
        dofs = np.zeros(m.nv, dtype=bool)
        for body in bodies:
            dofs |= turned[body].any(axis=0) if body else False
        lengths = self._lengths(data)
        joined = np.vstack([full, *lengths]) != 0.0  # what is weighed as one: trees, and those that tendons join
        while (more := dofs | joined[joined[:, dofs].any(axis=1)].any(axis=0)).sum() > dofs.sum():
            dofs = more
        own = np.flatnonzero(dofs)
        numbers, parts = [], []
        for body in [body for body in bodies if body and turned[body].any()]:
            linear, angular = turned[body][:3, own], data.ximat[body].reshape(3, 3).T @ turned[body][3:, own]
            numbers.append(self.place["body_mass"].start + body)
            parts.append(linear.T @ linear)
            for k in range(3):
                numbers.append(self.place["body_inertia"].start + 3 * body + k)
                parts.append(np.outer(angular[k], angular[k]))
        rows, by_length, targets = self._weighed(turned, *lengths, own)
        out.matrix, out.numbers = self._array(full[np.ix_(own, own)], wp.float64), self._array(np.array(numbers, int))
        out.parts = self._array(np.array(parts).reshape(len(parts), len(own), len(own)), wp.float64)
        out.rows, out.lengths = (
            self._array(np.array(rows).reshape(len(rows), len(own)), wp.float64),
            self._array(by_length),
        )
        out.entry = self._array(np.cumsum([0, *(len(row) for row in targets)]))
        flat = [entry for row in targets for entry in row]
        out.target = self._array(np.array([place for place, _ in flat], dtype=int))
        out.share = self._array(np.array([share for _, share in flat]), wp.float64)
        return out

    def _lengths(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Jacobian of the tendons ``[ntendon, nv]``, and of actuators ``[nu, nv]`` where there are muscles, else none.

        No other actuators are scaled by their acceleration.
        """
        m = self.model
        tendons, moments = np.zeros((m.ntendon, m.nv)), np.zeros((m.nu, m.nv))
        if m.ntendon:
            mujoco.mju_sparse2dense(tendons, data.ten_J.ravel(), *_sparse(m, data))
        if not ((m.actuator_gaintype == _MUSCLE) | (m.actuator_biastype == mujoco.mjtBias.mjBIAS_MUSCLE)).any():
            return tendons, moments[:0]
        mujoco.mju_sparse2dense(
            moments, data.actuator_moment.ravel(), data.moment_rownnz, data.moment_rowadr, data.moment_colind.ravel()
        )
        return tendons, moments

    def _weighed(
        self, turned: dict[int, np.ndarray], tendons: np.ndarray, moments: np.ndarray, own: np.ndarray
    ) -> tuple[list[np.ndarray], list[int], list[list[tuple[int, float]]]]:
        """Directions whose inverse weights MuJoCo keeps, which of them by length, and where each goes, in shares."""
        m, place = self.model, self.place
        rows, lengths, targets = [], [], []

        def add(row: np.ndarray, *entries: tuple[int, float], length: bool = False) -> None:
            if row.any():
                rows.append(row)
                lengths.append(int(length))
                targets.append(list(entries))

        for i, dof in enumerate(own):
            joint = int(m.dof_jntid[dof])
            first, kind = int(m.jnt_dofadr[joint]), int(m.jnt_type[joint])
            # the three that turn or move a body freely share their mean
            group = [dof]
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                group = range(first, first + 3) if dof < first + 3 else range(first + 3, first + 6)
            elif kind == mujoco.mjtJoint.mjJNT_BALL:
                group = range(first, first + 3)
            add(np.eye(len(own))[i], *((place["dof_invweight0"].start + d, 1.0 / len(group)) for d in group))
        for body, jacobian in turned.items():
            for k, row in enumerate(jacobian[:, own]):
                add(row, (place["body_invweight0"].start + 2 * body + k // 3, 1.0 / 3.0))
        for n, row in enumerate(tendons[:, own]):
            add(row, (place["tendon_invweight0"].start + n, 1.0))
        for n, row in enumerate(moments[:, own]):
            add(row, (place["actuator_acc0"].start + n, 1.0), length=True)
        return rows, lengths, targets


def _sparse(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row sizes, row starts and columns of the tendons' Jacobian, which newer versions keep in the model."""
    owner = model if hasattr(model, "ten_J_rownnz") else data
    return owner.ten_J_rownnz, owner.ten_J_rowadr, owner.ten_J_colind.ravel()


def _jacobian(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """Velocity of a body's centre of mass and its turning by the joints' ``[6, nv]``."""
    out = np.zeros((6, model.nv))
    mujoco.mj_jacBodyCom(model, data, out[:3], out[3:], body)
    return out


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
