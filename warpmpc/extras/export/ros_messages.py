# SPDX-License-Identifier: Apache-2.0
"""ROS 2 messages of what a run log holds, as ``rosbags`` has their types."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

if TYPE_CHECKING:
    from ..ros2.messages import Link

STORE = get_typestore(Stores.ROS2_JAZZY)
WORLD_FRAME = "world"
FIELDS = {
    "position": "positions",
    "velocity": "velocities",
    "acceleration": "accelerations",
    "effort": "effort",
}
"""Field of a trajectory's points by the mode of a drive."""


def message(kind: str, **fields: Any) -> Any:
    """A message of a type such as ``sensor_msgs/JointState``."""
    package, name = kind.split("/")
    return STORE.types[f"{package}/msg/{name}"](**fields)


def nanoseconds(time: float) -> int:
    """A time [s] in nanoseconds."""
    return round(1e9 * time)


def header(time: float, frame: str = "") -> Any:
    """A header with a time [s]."""
    return message("std_msgs/Header", stamp=_split("Time", time), frame_id=frame)


def joint_state(time: float, names: Sequence[str], position: np.ndarray, velocity: np.ndarray) -> Any:
    """``sensor_msgs/JointState``."""
    return message(
        "sensor_msgs/JointState",
        header=header(time),
        name=list(names),
        position=_floats(position),
        velocity=_floats(velocity),
        effort=_floats(()),
    )


def transforms(time: float, names: Sequence[str], poses: np.ndarray) -> Any:
    """``tf2_msgs/TFMessage`` of poses in the world ``[n, 7]`` (x, y, z, qx, qy, qz, qw)."""
    return message(
        "tf2_msgs/TFMessage",
        transforms=[
            message(
                "geometry_msgs/TransformStamped",
                header=header(time, WORLD_FRAME),
                child_frame_id=name,
                transform=message(
                    "geometry_msgs/Transform", translation=vector(pose[:3]), rotation=_quaternion(pose[3:])
                ),
            )
            for name, pose in zip(names, poses, strict=True)
        ],
    )


def pose_stamped(time: float, pose: np.ndarray) -> Any:
    """``geometry_msgs/PoseStamped`` of a pose in the world ``[7]``."""
    return message("geometry_msgs/PoseStamped", header=header(time, WORLD_FRAME), pose=_pose(pose))


def odometry(time: float, child: str, link: Link) -> Any:
    """``nav_msgs/Odometry`` of a body, its twist along its own axes and at its origin, as the message wants it."""
    linear, angular = np.split(link.twist, 2)
    spatial = message("geometry_msgs/Twist", linear=vector(linear), angular=vector(angular))
    unknown = np.zeros(36)
    return message(
        "nav_msgs/Odometry",
        header=header(time, WORLD_FRAME),
        child_frame_id=child,
        pose=message("geometry_msgs/PoseWithCovariance", pose=_pose(link.pose), covariance=unknown),
        twist=message("geometry_msgs/TwistWithCovariance", twist=spatial, covariance=unknown),
    )


def wrench(time: float, force: np.ndarray) -> Any:
    """``geometry_msgs/WrenchStamped`` of a force along the world's axes ``[3]`` [N]."""
    both = message("geometry_msgs/Wrench", force=vector(force), torque=vector(np.zeros(3)))
    return message("geometry_msgs/WrenchStamped", header=header(time, WORLD_FRAME), wrench=both)


def number(value: float) -> Any:
    """``std_msgs/Float64``."""
    return message("std_msgs/Float64", data=float(value))


def command(names: Sequence[str], control: np.ndarray) -> Any:
    """``std_msgs/Float64MultiArray`` of a control ``[nu]``; its dimension's label has the names."""
    size = len(control)
    dimension = message("std_msgs/MultiArrayDimension", label=", ".join(names), size=size, stride=size)
    layout = message("std_msgs/MultiArrayLayout", dim=[dimension], data_offset=0)
    return message("std_msgs/Float64MultiArray", layout=layout, data=_floats(control))


def trajectory(
    names: Sequence[str], modes: Sequence[str], times: np.ndarray, knots: np.ndarray, *, start: float
) -> Any:
    """``trajectory_msgs/JointTrajectory`` of a plan.

    A control stands in the field of its drive's mode, where other controls are NaN; fields of no drive are empty.

    Args:
        names: Names of the controls ``[nu]``.
        modes: Modes of their drives ``[nu]``.
        times: Times of the knots ``[P]`` [s].
        knots: The knots ``[P, nu]``.
        start: Time of the observation, which the points' times count from [s]; knots before it come first.
    """
    columns = {FIELDS[mode]: np.array([m == mode for m in modes]) for mode in dict.fromkeys(modes)}
    points = []
    for time, knot in zip(times, knots, strict=True):
        values = {
            field: _floats(np.where(columns[field], knot, np.nan) if field in columns else ())
            for field in FIELDS.values()
        }
        points.append(
            message("trajectory_msgs/JointTrajectoryPoint", **values, time_from_start=_split("Duration", time - start))
        )
    return message("trajectory_msgs/JointTrajectory", header=header(start), joint_names=list(names), points=points)


def marker(
    frame: str,
    pose: Sequence[float],
    *,
    kind: int,
    scale: np.ndarray,
    color: Sequence[float],
    points: list[Any],
    number: int,
) -> Any:
    """``visualization_msgs/Marker`` that stays in a frame for good.

    Args:
        frame: The frame.
        pose: Pose in it ``[7]``.
        kind: Type of the marker.
        scale: Full extents ``[3]`` [m].
        color: Red, green and blue.
        points: Corners of triangles.
        number: Id of the marker.
    """
    rgba = message("std_msgs/ColorRGBA", **dict(zip("rgba", map(float, (*color, 1.0)), strict=True)))
    nothing = message("sensor_msgs/CompressedImage", header=header(0.0), format="", data=np.zeros(0, np.uint8))
    return message(
        "visualization_msgs/Marker",
        header=header(0.0, frame),
        ns="scene",
        id=number,
        type=kind,
        action=0,
        pose=_pose(np.array(pose)),
        scale=vector(scale),
        color=rgba,
        lifetime=_split("Duration", 0.0),
        frame_locked=True,
        points=points,
        colors=[],
        texture_resource="",
        texture=nothing,
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=message("visualization_msgs/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )


def point(values: np.ndarray) -> Any:
    """``geometry_msgs/Point``."""
    return message("geometry_msgs/Point", **dict(zip("xyz", map(float, values), strict=True)))


def vector(values: np.ndarray) -> Any:
    """``geometry_msgs/Vector3``."""
    return message("geometry_msgs/Vector3", **dict(zip("xyz", map(float, values), strict=True)))


def _quaternion(values: np.ndarray) -> Any:
    return message("geometry_msgs/Quaternion", **dict(zip("xyzw", map(float, values), strict=True)))


def _pose(pose: np.ndarray) -> Any:
    return message("geometry_msgs/Pose", position=point(pose[:3]), orientation=_quaternion(pose[3:]))


def _split(kind: str, time: float) -> Any:
    seconds, rest = divmod(nanoseconds(time), 10**9)
    return message(f"builtin_interfaces/{kind}", sec=seconds, nanosec=rest)


def _floats(values: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.array(values, dtype=np.float64)
