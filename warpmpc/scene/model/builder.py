# SPDX-License-Identifier: Apache-2.0
"""From a validated scene to one Newton world: a ``newton.ModelBuilder`` and the layout of its state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import newton
import numpy as np
import warp as wp
from newton import GeoType, JointType, ShapeFlags

from ..errors import Mistakes, SceneError
from ..schema import DriveMode, Object, Obstacle, Robot, Scene, ShapeKind
from .assets import AssetKind, asset_kind, resolve_asset
from .controls import Actuators, drive_robot
from .importers import given_frames, import_links, new_builder, transform
from .layout import GOAL, IDENTITY, WORLD, Entity, Layout, ShapeInfo, accelerator
from .mjcf_robot import MjcfRobots, add_mjcf_robot

if TYPE_CHECKING:
    from collections.abc import Collection

_KINDS = {
    GeoType.BOX: "box",
    GeoType.SPHERE: "sphere",
    GeoType.CYLINDER: "cylinder",
    GeoType.CAPSULE: "capsule",
    GeoType.PLANE: "plane",
    GeoType.ELLIPSOID: "ellipsoid",
    GeoType.CONE: "cone",
    GeoType.MESH: "mesh",
    GeoType.CONVEX_MESH: "mesh",
}
_SINGLE_AXES = (JointType.PRISMATIC, JointType.REVOLUTE, JointType.D6)


@dataclass(frozen=True)
class World:
    """One Newton world of a scene."""

    builder: newton.ModelBuilder
    layout: Layout
    mjcf_robots: MjcfRobots
    """Its MJCF robots."""
    actuator_name: tuple[str, ...]
    """Actuator of an MJCF file behind each control, empty for controls of drives."""
    repaired: tuple[str, ...]
    """What is not as the assets' files say."""


def build_world(scene: Scene) -> World:
    """Build one world of a scene.

    Raises:
        SceneError: If an asset is missing or broken, or the scene names links or joints that its asset lacks.
    """
    world = _build(scene)
    if not world.layout.nu:
        raise SceneError(
            "there is nothing to control: the assets have no actuators; give a robot with joints a drive",
            key="robot.drive",
            file=scene.path,
        )
    return world


def _build(scene: Scene) -> World:
    builder = new_builder()
    entities: list[Entity] = []
    axes: list[str] = []
    frames: dict[str, tuple[int, tuple[float, ...]]] = {}
    actuators, mjcf_robots = Actuators(), MjcfRobots()
    repaired: list[str] = []

    mistakes = Mistakes()

    for robot in scene.robot:
        with mistakes.of_part():
            entities.append(_add_robot(builder, robot, scene, frames, actuators, axes, mjcf_robots, repaired))
    for item in scene.object:
        with mistakes.of_part():
            entities.append(_add_object(builder, item, scene))
            frames[item.name] = (entities[-1].bodies[0], IDENTITY)
    for item in scene.obstacle:
        with mistakes.of_part():
            entities.append(_add_obstacle(builder, item, scene))
            frames[item.name] = (WORLD, (*item.position, *item.rotation))
    mistakes.raise_all()
    frames["goal"] = (GOAL, IDENTITY)
    mjcf_robots.gravity = scene.engine.gravity or mjcf_robots.gravity
    if scene.ground is not None:
        plane = builder.add_shape_plane(
            plane=(0.0, 0.0, 1.0, -float(scene.ground.height)),
            width=0.0,
            length=0.0,
            cfg=newton.ModelBuilder.ShapeConfig(mu=scene.ground.friction),
            label="ground",
        )
        entities.append(Entity("ground", "ground", shapes=(plane,)))
    _filter_ground(builder, scene, entities)
    layout = _layout(builder, entities, frames, actuators, axes, mjcf_robots)
    return World(builder, layout, mjcf_robots, actuators.own(), (*repaired, *mjcf_robots.repaired))


def build_rest(scene: Scene, mjcf_robots: Collection[str]) -> World | None:
    """A world of everything but some robots, or None if nothing is left; Newton translates no world without a joint.

    Raises:
        SceneError: As :func:`build_world`.
    """
    left = tuple(robot for robot in scene.robot if robot.name not in mjcf_robots)
    if not (left or scene.object or scene.obstacle or scene.ground is not None):
        return None
    return _build(scene.model_copy(update={"robot": left}))


def _add_robot(
    builder,
    robot: Robot,
    scene: Scene,
    frames: dict,
    actuators: Actuators,
    axes: list[str],
    mjcf_robots: MjcfRobots,
    repaired: list[str],
) -> Entity:
    key = f"robot.{robot.name}"
    base = scene.path.parent if scene.path else None
    path = resolve_asset(robot.asset, base=base, key=f"{key}.asset", file=scene.path)
    kind = asset_kind(path, key=f"{key}.asset", file=scene.path)
    if kind is AssetKind.MJCF:
        return add_mjcf_robot(builder, new_builder(), robot, path, scene, frames, actuators, axes, mjcf_robots)
    _refuse_mjcf_keys(robot, kind, scene)
    part, lines, losses = import_links(path, kind, robot, file=scene.path)
    repaired += lines
    mjcf_robots.notes += losses
    if not part.body_count:
        raise SceneError("this asset has no links", key=f"{key}.asset", file=scene.path, found=str(path))

    links = [label.rsplit("/", 1)[-1] for label in part.body_label]
    joints = [label.rsplit("/", 1)[-1] for label in part.joint_label]
    part.body_label[:] = [f"{robot.name}/{link}" for link in links]
    part.joint_label[:] = [f"{robot.name}/{joint}" for joint in joints]
    if robot.friction is not None:
        part.shape_material_mu[:] = [robot.friction] * part.shape_count
    if robot.gravity_compensation:
        part.custom_attributes["mujoco:gravcomp"].values = dict.fromkeys(range(part.body_count), 1.0)
    own = _axis_names(part, joints)
    axes += [f"{robot.name}/{name}" if name else "" for name in own]
    first = {"first_coord": builder.joint_coord_count, "first_dof": builder.joint_dof_count}
    mistakes = Mistakes()
    with mistakes.of_part():
        drive_robot(part, robot, own, scene, actuators, **first)
    with mistakes.of_part():
        given = given_frames(robot, links, builder.body_count, scene)
    mistakes.raise_all()

    first_body, first_shape, first_joint = builder.body_count, builder.shape_count, builder.joint_count
    builder.add_builder(part)
    for i, link in enumerate(links):
        frames[f"{robot.name}/{link}"] = (first_body + i, IDENTITY)
    frames[robot.name] = (first_body + _root(part), IDENTITY)
    frames.update(given)
    return Entity(
        robot.name,
        "robot",
        bodies=tuple(range(first_body, builder.body_count)),
        shapes=tuple(range(first_shape, builder.shape_count)),
        joints=tuple(range(first_joint, builder.joint_count)),
    )


def _refuse_mjcf_keys(robot: Robot, kind: AssetKind, scene: Scene) -> None:
    """Only MJCF files bring actuators, mocap bodies and keyframes."""
    for number, drive in enumerate(robot.drive):
        if drive.mode is DriveMode.MOCAP:
            raise SceneError(
                f"a {kind.upper()} file has no mocap bodies: take mode 'velocity' with joints",
                key=f"robot.{robot.name}.drive" + f".{number}" * (len(robot.drive) > 1) + ".mode",
                file=scene.path,
                found=str(drive.mode),
            )
    if "drive" not in robot.model_fields_set:
        raise SceneError(
            f"a {kind.upper()} file brings no actuators: give the robot a drive, or drive = [] to what contact "
            "alone moves",
            key=f"robot.{robot.name}.drive",
            file=scene.path,
            found=None,
        )
    if robot.keyframe is not None:
        raise SceneError(
            f"a {kind.upper()} file has no keyframes: give joint_q",
            key=f"robot.{robot.name}.keyframe",
            file=scene.path,
            found=robot.keyframe,
        )


def _root(part: newton.ModelBuilder) -> int:
    """The last link before the robot branches or grows arms of its own: what moves when a base moves."""
    body = 0
    while part.body_mass[body] == 0.0 or part.body_shapes.get(body, []) == []:
        children = [c for p, c in zip(part.joint_parent, part.joint_child, strict=True) if p == body]
        if len(children) != 1:
            break
        body = children[0]
    return body


def _add_object(builder, item: Object, scene: Scene) -> Entity:
    given = (
        {"mass": item.mass, "inertia": wp.diag(wp.vec3(*item.inertia)), "lock_inertia": True} if item.inertia else {}
    )
    body = builder.add_body(xform=transform(item.position, item.rotation), label=item.name, **given)
    shape = _add_shape(builder, body, item, scene, wp.transform_identity(), mass=item.mass)
    parts = {"bodies": (body,), "shapes": (shape,), "joints": (builder.joint_count - 1,)}
    return Entity(item.name, "object", damping=(item.linear_damping, item.angular_damping), **parts)


def _add_obstacle(builder, item: Obstacle, scene: Scene) -> Entity:
    pose = transform(item.position, item.rotation)
    shape = _add_shape(builder, WORLD, item, scene, pose, mass=0.0)
    return Entity(item.name, "obstacle", shapes=(shape,), movable=item.movable)


def _add_shape(builder, body: int, item: Object | Obstacle, scene: Scene, pose: wp.transform, *, mass: float) -> int:
    size = item.size or ()
    match item.shape:
        case ShapeKind.BOX:
            add, volume = builder.add_shape_box, size[0] * size[1] * size[2]
            dimensions = {"hx": size[0] / 2, "hy": size[1] / 2, "hz": size[2] / 2}
        case ShapeKind.SPHERE:
            add, volume, dimensions = builder.add_shape_sphere, 4.0 / 3.0 * np.pi * size[0] ** 3, {"radius": size[0]}
        case ShapeKind.CYLINDER | ShapeKind.CAPSULE:
            add, volume = builder.add_shape_cylinder, np.pi * size[0] ** 2 * size[1]
            if item.shape is ShapeKind.CAPSULE:
                add, volume = builder.add_shape_capsule, volume + 4.0 / 3.0 * np.pi * size[0] ** 3
            dimensions = {"radius": size[0], "half_height": size[1] / 2}
        case ShapeKind.PLANE:
            add, volume, dimensions = builder.add_shape_plane, 1.0, {"width": 0.0, "length": 0.0}
        case ShapeKind.MESH:
            mesh = _load_mesh(item, scene)
            add, volume, dimensions = builder.add_shape_convex_hull, mesh.mass, {"mesh": mesh}
    cfg = newton.ModelBuilder.ShapeConfig(density=mass / volume, mu=item.friction)
    # an object's friction holds against everything it touches
    priority = {"custom_attributes": {"mujoco:geom_priority": 1}} if isinstance(item, Object) else {}
    return add(body=body, xform=pose, cfg=cfg, label=item.name, color=item.color, **dimensions, **priority)


def _load_mesh(item: Object | Obstacle, scene: Scene) -> newton.Mesh:
    import trimesh

    kind = "object" if isinstance(item, Object) else "obstacle"
    key = f"{kind}.{item.name}.mesh"
    path = resolve_asset(item.mesh, base=scene.path.parent if scene.path else None, key=key, file=scene.path)
    try:
        mesh = trimesh.load(path, force="mesh")
        hull = mesh.convex_hull
    except Exception as error:  # trimesh raises what its format readers raise
        raise SceneError(f"this mesh cannot be read: {error}", key=key, file=scene.path, found=str(path)) from error
    vertices = np.asarray(hull.vertices, dtype=np.float32) * item.scale
    return newton.Mesh(vertices, np.asarray(hull.faces, dtype=np.int32).ravel())


def _filter_ground(builder, scene: Scene, entities: list[Entity]) -> None:
    """Robots that glide on their joints do not touch planes."""
    planes = [i for i in range(builder.shape_count) if builder.shape_type[i] == GeoType.PLANE]
    for robot, entity in zip(scene.robot, entities, strict=False):
        if not robot.ground_contact:
            for shape in entity.shapes:
                for plane in planes:
                    builder.add_shape_collision_filter_pair(shape, plane)


def _layout(
    builder,
    entities: list[Entity],
    frames: dict,
    actuators: Actuators,
    robot_axes: list[str],
    mjcf_robots: MjcfRobots,
) -> Layout:
    axes = np.array(builder.joint_axis, dtype=np.float32).reshape(-1, 3)
    dims = np.array(builder.joint_dof_dim, dtype=np.int32).reshape(-1, 2)
    q_start, qd_start = np.array(builder.joint_q_start), np.array(builder.joint_qd_start)
    dof_coord = np.full(builder.joint_dof_count, -1, dtype=np.int32)
    one_to_one = (newton.JointType.PRISMATIC, newton.JointType.REVOLUTE, newton.JointType.D6)
    for joint, kind in enumerate(builder.joint_type):
        if kind in one_to_one:
            count = dims[joint].sum()
            dof_coord[qd_start[joint] : qd_start[joint] + count] = q_start[joint] + np.arange(count)
    meshes: list[tuple[np.ndarray, np.ndarray]] = []
    owner = {shape: entity.name for entity in entities for shape in entity.shapes}
    shapes = tuple(_shape_info(builder, i, owner.get(i, ""), meshes) for i in range(builder.shape_count))
    poses = [np.array(x, dtype=np.float32) for x in (builder.joint_X_p, builder.joint_X_c)]
    start = {name: np.array(getattr(builder, name), dtype=np.float32) for name in ("joint_q", "joint_qd")}
    mjcf_robots.activations += [accelerator(a["dof"]) for a in actuators.actuator if a["mode"] == "acceleration"]
    return Layout(
        joint_name=tuple(builder.joint_label),
        joint_type=np.array(builder.joint_type, dtype=np.int32),
        joint_parent=np.array(builder.joint_parent, dtype=np.int32),
        joint_child=np.array(builder.joint_child, dtype=np.int32),
        joint_q_start=q_start.astype(np.int32),
        joint_qd_start=qd_start.astype(np.int32),
        joint_dof_dim=dims,
        joint_pose_parent=poses[0].reshape(-1, 7),
        joint_pose_child=poses[1].reshape(-1, 7),
        dof_axis=axes,
        dof_lower=np.array(builder.joint_limit_lower, dtype=np.float32),
        dof_upper=np.array(builder.joint_limit_upper, dtype=np.float32),
        dof_speed=np.array(builder.joint_velocity_limit, dtype=np.float32),
        dof_coord=dof_coord,
        dof_name=(*robot_axes, *[""] * (builder.joint_dof_count - len(robot_axes))),
        body_name=tuple(builder.body_label),
        body_com=np.array(builder.body_com, dtype=np.float32).reshape(-1, 3),
        body_mass=np.array(builder.body_mass, dtype=np.float32),
        body_inertia=np.array(builder.body_inertia, dtype=np.float32).reshape(-1, 3, 3),
        **start,
        entities=tuple(entities),
        shapes=shapes,
        frame_name=tuple(frames),
        frame_body=np.array([body for body, _ in frames.values()], dtype=np.int32),
        frame_pose=np.array([pose for _, pose in frames.values()], dtype=np.float32),
        meshes=tuple(meshes),
        **actuators.arrays(),
        **mjcf_robots.arrays(start, len(actuators.control)),
    )


def _shape_info(builder, i: int, entity: str, meshes: list) -> ShapeInfo:
    kind = _KINDS.get(builder.shape_type[i], "mesh")
    flags = builder.shape_flags[i]
    mesh = None
    if kind == "mesh" and builder.shape_source[i] is not None:
        source = builder.shape_source[i]
        meshes.append(
            (
                np.asarray(source.vertices, dtype=np.float32).reshape(-1, 3),
                np.asarray(source.indices, dtype=np.int32).reshape(-1, 3),
            )
        )
        mesh = len(meshes) - 1
    color = builder.shape_color[i]
    return ShapeInfo(
        name=builder.shape_label[i],
        entity=entity,
        body=builder.shape_body[i],
        kind=kind,
        pose=tuple(float(x) for x in builder.shape_transform[i]),
        scale=tuple(float(x) for x in builder.shape_scale[i]),
        collides=bool(flags & ShapeFlags.COLLIDE_SHAPES),
        visible=bool(flags & ShapeFlags.VISIBLE),
        color=None if color is None else tuple(float(c) for c in color),
        mesh=mesh,
    )


def _axis_names(part: newton.ModelBuilder, joints: list[str]) -> list[str | None]:
    """Name of every joint velocity of a robot, None for those of free and ball joints.

    A joint of one axis gives its own name; the axes of one that has several are numbered, ``joint:0``.

    Args:
        part: The robot's builder.
        joints: Name of each joint.
    """
    names: list[str | None] = []
    for joint, name in enumerate(joints):
        count = sum(part.joint_dof_dim[joint])
        if part.joint_type[joint] not in _SINGLE_AXES:
            names += [None] * count
        elif count == 1:
            names.append(name)
        else:
            names += [f"{name}:{k}" for k in range(count)]
    return names
