# SPDX-License-Identifier: Apache-2.0
"""A run log as an MCAP file of ROS 2 messages, which Foxglove and ROS 2 play."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.writer import Writer

from ...loop.estimation.free_joints import free_joints
from ...physics.runtime.files import replacing
from ...scene.model.compiled import compile_scene
from ...scene.model.layout import IDENTITY, WORLD
from ...scene.task.task import Task
from ..record.replay import logged_scene, require_plans
from ..record.shapes import DEFAULT_COLOR, mesh_of, shown_shapes
from ..ros2.messages import FloatingBody
from . import ros_messages as ros
from .data_sets import task_values

if TYPE_CHECKING:
    from ...loop.log.run_log import RunLog
    from ...scene.model.layout import Layout, ShapeInfo

Stamped = tuple[float, str, Any]
"""Time [s], topic and message."""
CUBE, SPHERE, CYLINDER, TRIANGLES = 1, 2, 3, 11
"""Types of ``visualization_msgs/Marker``."""
MOST_TRIANGLES = 500
"""Triangles of a mesh that is drawn as it is; of larger ones the convex hull is."""


def write_mcap(log: RunLog, path: Path) -> None:
    """Write a run log as ROS 2 messages, CDR encoded and with their definitions.

    Topics: ``/joint_states``, ``/tf`` (all bodies, mocap bodies too), ``/odom/BODY`` of free joints, ``/scene`` (its
    shapes), ``/force/PAIR``, ``/goal_error/NAME``; ``/command``; ``/task/NAME``; ``/plan``, ``/plan/cost``,
    ``/plan/cost/TERM``, ``/plan/beta``, ``/plan/eta``. Times are those of the simulation,
    or of the robot's clock.

    Args:
        log: The log, with its plans.
        path: The file; replaced when the new one is whole.

    Raises:
        SceneError: If this version of warpmpc cannot read the scene, or its files are not here.
        ValueError: If the log lacks what its plans were made from.
        OSError: If the file cannot be written.
    """
    require_plans(log)
    scene = logged_scene(log)
    layout = compile_scene(scene).layout
    messages: list[Stamped] = [(float(log.states.time[0]), "/scene", _markers(layout))]
    messages += [*_states(log, layout), *_controls(log), *_plans(log, layout), *_task(log, Task(scene))]
    with replacing(path, "wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="warpmpc")
        channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for time, topic, content in sorted(messages, key=lambda entry: entry[0]):
            kind = content.__msgtype__
            if kind not in schemas:
                text, _ = ros.STORE.generate_msgdef(kind, ros_version=2)
                schemas[kind] = writer.register_schema(kind, "ros2msg", text.encode())
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
            at, data = ros.nanoseconds(time), bytes(ros.STORE.serialize_cdr(content, kind))
            writer.add_message(channels[topic], log_time=at, publish_time=at, data=data)
        writer.add_metadata("warpmpc", {key: json.dumps(value) for key, value in log.origin.items()})
        writer.finish()


def _states(log: RunLog, layout: Layout) -> Iterator[Stamped]:
    axes = np.flatnonzero(layout.dof_coord >= 0)
    names = [layout.dof_name[dof] for dof in axes]
    free = {layout.body_name[layout.joint_child[j]]: FloatingBody(layout, j) for j in free_joints(layout).values()}
    for state in log.states:
        time = float(state.time)
        yield (
            time,
            "/joint_states",
            ros.joint_state(time, names, state.joint_q[layout.dof_coord[axes]], state.joint_qd[axes]),
        )
        yield time, "/tf", ros.transforms(time, layout.body_name, state.body_q)
        for name, joint in free.items():
            link = joint.link(state.joint_q[joint.q], state.joint_qd[joint.qd])
            yield time, topic("odom", name), ros.odometry(time, name, link)
        for name, force in zip(log.names["pairs"], state.contact_force, strict=True):
            yield time, topic("force", name), ros.wrench(time, force)
        for name, error in zip(log.names["errors"], state.goal_error, strict=True):
            yield time, topic("goal_error", name), ros.number(error)


def _controls(log: RunLog) -> Iterator[Stamped]:
    for time, control in zip(log.states.time, log.controls.control):  # noqa: B905, the last state has none
        if np.isfinite(control).all():
            yield float(time), "/command", ros.command(log.names["controls"], control)


def _plans(log: RunLog, layout: Layout) -> Iterator[Stamped]:
    modes = [_mode(layout, control) for control in range(layout.nu)]
    for plan in log.plans:
        time = float(plan.time)
        knots = plan.knot_time, plan.knots
        yield time, "/plan", ros.trajectory(log.names["controls"], modes, *knots, start=time)
        for name in ("cost", "beta", "eta"):
            yield time, topic("plan", name), ros.number(plan[name])
        for name, cost in zip(log.names["terms"], plan.terms, strict=True):
            yield time, topic("plan", "cost", name), ros.number(cost)


def _task(log: RunLog, task: Task) -> Iterator[Stamped]:
    """Poses and scalars of the task where they change, frames of movable obstacles."""
    movable = [obstacle.name for obstacle in task.scene.obstacle if obstacle.movable]
    for name, rows in task_values(task, log.plans.task).items():
        changed = np.flatnonzero(np.r_[True, (rows[1:] != rows[:-1]).any(axis=1)])
        for n in changed:
            time = float(log.plans.time[n])
            pose = name in task.pose_name
            yield time, topic("task", name), ros.pose_stamped(time, rows[n]) if pose else ros.number(rows[n, 0])
            if name in movable:
                yield time, "/tf", ros.transforms(time, [name], rows[n : n + 1])


def _mode(layout: Layout, control: int) -> str:
    """Mode of the drive of a control; an MJCF file's own actuators count as efforts."""
    rows = np.flatnonzero(layout.actuator_matrix[:, control])
    return layout.actuator_mode[rows[0]] if len(rows) else "effort"


def topic(*parts: str) -> str:
    """A topic of parts, in the letters that ROS allows."""
    tokens = re.sub(r"[^A-Za-z0-9_/]", "_", "/".join(parts)).split("/")
    return "/" + "/".join(f"_{token}" if token[:1].isdigit() else token for token in tokens if token)


def _markers(layout: Layout) -> Any:
    """``visualization_msgs/MarkerArray`` of all shapes, each fixed to the frame of its body; planes are left out."""
    shapes = [shape for entity in layout.entities for shape in shown_shapes(layout, entity)]
    found = [_marker(shape, layout, i) for i, shape in enumerate(shapes) if shape.kind != "plane"]
    return ros.message("visualization_msgs/MarkerArray", markers=[marker for marker in found if marker is not None])


def _marker(shape: ShapeInfo, layout: Layout, number: int) -> Any:
    """Marker of a shape; None where a mesh is missing."""
    a, b, _ = shape.scale
    simple = {"box": (CUBE, shape.scale), "sphere": (SPHERE, (a, a, a))}
    simple |= {"ellipsoid": (SPHERE, shape.scale), "cylinder": (CYLINDER, (a, a, b))}
    points: list[Any] = []
    if shape.kind in simple:
        kind, half = simple[shape.kind]
    else:
        mesh = mesh_of(shape, layout, fine=False)
        if mesh is None:
            return None
        if len(mesh.faces) > MOST_TRIANGLES:
            mesh = mesh.convex_hull
        kind, half = TRIANGLES, (0.5, 0.5, 0.5)
        points = [ros.point(corner) for corner in mesh.triangles.reshape(-1, 3)]
    movable = shape.entity in layout.movable  # its frame is where the task puts it
    frame = shape.entity if movable else ros.WORLD_FRAME if shape.body == WORLD else layout.body_name[shape.body]
    return ros.marker(
        frame,
        IDENTITY if movable else shape.pose,
        kind=kind,
        scale=2.0 * np.array(half),
        color=shape.color or DEFAULT_COLOR,
        points=points,
        number=number,
    )
