# SPDX-License-Identifier: Apache-2.0
"""From a compiled MJCF file to links of a Newton builder: bodies, joints and shapes in the file's own order and names.

Everything is read from the model that MuJoCo compiles, so that includes, defaults, frames and meshes are as MuJoCo
understands them; the builder gives state layouts, recordings, distance fields and Newton's other solvers their view.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import newton
import numpy as np
import warp as wp
from newton import GeoType

from ...physics.collisions import colliding_pairs
from ..errors import SceneError
from .mjcf import is_floor

if TYPE_CHECKING:
    from pathlib import Path

    from ..schema import Robot

_FREE, _BALL, _SLIDE, _HINGE = range(4)  # mujoco.mjtJoint
_SHAPES = {
    mujoco.mjtGeom.mjGEOM_PLANE: GeoType.PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE: GeoType.SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE: GeoType.CAPSULE,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: GeoType.ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_CYLINDER: GeoType.CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX: GeoType.BOX,
    mujoco.mjtGeom.mjGEOM_MESH: GeoType.MESH,
}
_HIDDEN_GROUP = 3
"""MuJoCo's viewers hide geoms from this group on."""
UNLIMITED = 1e10
"""What Newton takes for no limit."""


@dataclass(frozen=True)
class Links:
    """Names of the links of an MJCF file."""

    axes: list[str | None]
    """Name of every joint velocity, None for those of free and ball joints."""
    mocap: list[int]
    """Mocap bodies, in MuJoCo's order."""
    left_out: list[str]
    """Geoms that have no shape in Newton's terms."""


def add_links(
    part: newton.ModelBuilder, model: mujoco.MjModel, robot: Robot, place: wp.transform, *, file: Path | None = None
) -> Links:
    """Add the bodies, joints and shapes of a compiled MJCF file to an empty builder.

    Args:
        part: The builder.
        model: The file's model.
        robot: The robot, for its name.
        place: Where the origin of the file is.
        file: Scene file, for errors.

    Raises:
        SceneError: If a body's joints cannot be put as one joint of Newton's.
    """
    axes: list[str | None] = []
    articulation: list[int] = []
    for b in range(1, model.nbody):
        rotation = _matrix(model.body_iquat[b])
        part.add_link(
            mass=float(model.body_mass[b]),
            com=wp.vec3(*model.body_ipos[b]),
            inertia=wp.mat33(*(rotation @ np.diag(model.body_inertia[b]) @ rotation.T).ravel()),
            label=f"{robot.name}/{model.body(b).name}",
        )
        if model.body_parentid[b] == 0 and articulation:
            part.add_articulation(articulation)
            articulation = []
        articulation.append(part.joint_count)
        axes += _add_joint(part, model, b, place, robot, file)
    if articulation:
        part.add_articulation(articulation)
    left_out = _add_shapes(part, model, place, robot.name)
    _filter_pairs(part, model)
    return Links(axes, [b - 1 for b in range(1, model.nbody) if model.body_mocapid[b] >= 0], left_out)


def _add_joint(part, model: mujoco.MjModel, b: int, place: wp.transform, robot: Robot, file) -> list[str | None]:
    """Add the joint between a body and its parent; returns the names of its axes."""
    ids = list(range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]))
    kinds = [int(model.jnt_type[j]) for j in ids]
    names = [model.joint(j).name for j in ids]
    parent = int(model.body_parentid[b]) - 1
    local = pose(model.body_pos[b], model.body_quat[b])
    if parent < 0:
        local = place * local
    label = f"{robot.name}/{'_'.join(names) or model.body(b).name + '_fixed'}"
    if not ids:
        part.add_joint_fixed(parent, b - 1, parent_xform=local, label=label)
        return []
    start = model.qpos0[model.jnt_qposadr[ids[0]] :]
    if kinds == [_FREE]:
        part.add_joint_free(b - 1, label=label)
        free = place * pose(start[:3], start[3:7])
        part.joint_q[-7:] = [*free.p, *free.q]
        return [None] * 6
    if kinds == [_BALL]:
        anchor = pose(model.jnt_pos[ids[0]])
        part.add_joint_ball(parent, b - 1, parent_xform=local * anchor, child_xform=anchor, label=label)
        return [None] * 3
    wrong = _why_not_one_joint(model, ids, kinds)
    if wrong:
        raise SceneError(
            f"the joints of body '{model.body(b).name}' cannot be taken together: {wrong}",
            key=f"robot.{robot.name}.asset",
            file=file,
            found=names,
            allowed="slides before hinges about one point, with ref on slides and on the last hinge alone",
        )
    slides = kinds.count(_SLIDE)
    point = model.jnt_pos[ids[-1]] if len(ids) > slides else np.zeros(3)
    # joints stand at ref in the file's own pose, Newton's at zero
    shift = sum((start[k] * model.jnt_axis[ids[k]] for k in range(slides)), np.zeros(3))
    turn = wp.quat_from_axis_angle(wp.vec3(*model.jnt_axis[ids[-1]]), float(start[len(ids) - 1]))
    dofs = [_dof(model, j) for j in ids]
    part.add_joint_d6(
        parent,
        b - 1,
        linear_axes=dofs[:slides],
        angular_axes=dofs[slides:],
        parent_xform=local * pose(point - shift),
        child_xform=wp.transform(wp.vec3(*point), turn) if len(ids) > slides else pose(point),
        label=label,
    )
    part.joint_q[-len(ids) :] = [float(q) for q in start[: len(ids)]]
    if len(ids) == 1:
        part.joint_type[-1] = newton.JointType.PRISMATIC if slides else newton.JointType.REVOLUTE
    return names


def _why_not_one_joint(model: mujoco.MjModel, ids: list[int], kinds: list[int]) -> str:
    """Return what keeps slides and hinges of one body from being one joint of Newton's, or nothing."""
    if not set(kinds) <= {_SLIDE, _HINGE}:
        return "a free or ball joint stands alone"
    if kinds != sorted(kinds):
        return "a slide comes after a hinge"
    hinges = [j for j, kind in zip(ids, kinds, strict=True) if kind == _HINGE]
    if len(hinges) > 3 or len(ids) - len(hinges) > 3:
        return "there are more than three slides or three hinges"
    if any(np.abs(model.jnt_pos[j] - model.jnt_pos[hinges[0]]).max() > 1e-9 for j in hinges):
        return "the hinges turn about different points"
    if any(model.qpos0[model.jnt_qposadr[j]] != 0.0 for j in hinges[:-1]):
        return "a hinge before the last has a ref"
    return ""


def _dof(model: mujoco.MjModel, j: int) -> newton.ModelBuilder.JointDofConfig:
    limited = bool(model.jnt_limited[j])
    dof = model.jnt_dofadr[j]
    lower, upper = model.jnt_range[j] if limited else (-UNLIMITED, UNLIMITED)
    config = newton.ModelBuilder.JointDofConfig(
        axis=wp.vec3(*model.jnt_axis[j]),
        limit_lower=float(lower),
        limit_upper=float(upper),
        armature=float(model.dof_armature[dof]),
        friction=float(model.dof_frictionloss[dof]),
    )
    if model.jnt_actfrclimited[j]:
        config.effort_limit = float(np.abs(model.jnt_actfrcrange[j]).max())
    return config


def _add_shapes(part, model: mujoco.MjModel, place: wp.transform, robot: str) -> list[str]:
    """Add every geom as a shape; returns what is to be said about those that cannot be one."""
    left_out = []
    paired = {int(g) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True) for g in pair}
    drawn = (model.geom_group < _HIDDEN_GROUP) & (model.geom_rgba[:, 3] > 0)
    for g in range(model.ngeom):
        name = model.geom(g).name
        kind = _SHAPES.get(mujoco.mjtGeom(int(model.geom_type[g])))
        if kind is None:
            what = mujoco.mjtGeom(int(model.geom_type[g])).name.removeprefix("mjGEOM_").lower()
            left_out.append(f"geom '{name}' ({what}): simulated, but not drawn and not seen by terms")
            continue
        collides = bool(model.geom_contype[g] | model.geom_conaffinity[g]) or g in paired
        body, at = int(model.geom_bodyid[g]) - 1, pose(model.geom_pos[g], model.geom_quat[g])
        scale, mesh = tuple(float(x) for x in model.geom_size[g]), None
        if kind == GeoType.MESH:
            kind = GeoType.CONVEX_MESH if collides else GeoType.MESH
            scale, mesh = (1.0, 1.0, 1.0), _mesh(model, int(model.geom_dataid[g]))
        elif kind == GeoType.PLANE:
            scale = (0.0, 0.0, 0.0)  # MuJoCo's planes never end, whatever size they are drawn with
        material = int(model.geom_matid[g])
        color = model.mat_rgba[material] if material >= 0 else model.geom_rgba[g]
        part.add_shape(
            body=body,
            type=kind,
            xform=at if body >= 0 or is_floor(model.geom_type[g]) else place * at,
            cfg=newton.ModelBuilder.ShapeConfig(
                density=0.0,
                mu=float(model.geom_friction[g, 0]),
                has_shape_collision=collides,
                is_visible=bool(drawn[g]) or not drawn.any(),
            ),
            scale=wp.vec3(*scale),
            src=mesh,
            color=wp.vec3(*(float(c) for c in color[:3])),
            label=f"{robot}/{name}",
        )
    return left_out


def _mesh(model: mujoco.MjModel, m: int) -> newton.Mesh:
    vertices = model.mesh_vert[model.mesh_vertadr[m] : model.mesh_vertadr[m] + model.mesh_vertnum[m]]
    faces = model.mesh_face[model.mesh_faceadr[m] : model.mesh_faceadr[m] + model.mesh_facenum[m]]
    corners = np.array(faces, dtype=np.int32).ravel()
    return newton.Mesh(np.array(vertices, dtype=np.float32), corners, compute_inertia=False)


def _filter_pairs(part: newton.ModelBuilder, model: mujoco.MjModel) -> None:
    """Tell Newton's own contact pipeline which of the robot's shapes never meet by the file's own rule."""
    shapes = {label: i for i, label in enumerate(part.shape_label)}
    robot = part.shape_label[0].partition("/")[0] if part.shape_label else ""
    index = [shapes.get(f"{robot}/{model.geom(g).name}", -1) for g in range(model.ngeom)]
    meets = colliding_pairs(model)
    for a in range(model.ngeom):
        for b in range(a):
            if min(index[a], index[b]) >= 0 and not meets[a, b] and model.geom_bodyid[a] != model.geom_bodyid[b]:
                part.add_shape_collision_filter_pair(index[b], index[a])


def pose(position: np.ndarray, rotation: np.ndarray = (1.0, 0.0, 0.0, 0.0)) -> wp.transform:
    """A pose of MuJoCo's (quaternion w, x, y, z) as Warp's."""
    w, x, y, z = (float(r) for r in rotation)
    return wp.transform(wp.vec3(*(float(p) for p in position)), wp.quat(x, y, z, w))


def _matrix(rotation: np.ndarray) -> np.ndarray:
    """Rotation matrix [3, 3] of a quaternion (w, x, y, z)."""
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, rotation)
    return out.reshape(3, 3)
