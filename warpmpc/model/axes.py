# SPDX-License-Identifier: Apache-2.0
"""Names of single joint axes: a joint of several axes has one name per axis in MJCF, but one in all in Newton."""

from __future__ import annotations

from typing import TYPE_CHECKING

from newton import JointType

from .assets import AssetKind, asset_kind

if TYPE_CHECKING:
    from pathlib import Path

    import newton

_ONE_TO_ONE = (JointType.PRISMATIC, JointType.REVOLUTE, JointType.D6)


def axis_names(part: newton.ModelBuilder, joints: list[str], path: Path) -> list[str | None]:
    """Name of every joint velocity of a robot, None for those of free and ball joints.

    A joint of one axis gives its own name. MJCF may put several joints on one body, which Newton makes one joint of
    several axes: they keep the names of the file. Elsewhere the axes of such a joint are numbered, ``joint:0``.

    Args:
        part: The robot's builder.
        joints: Name of each joint.
        path: The robot's asset.
    """
    together = _joints_by_body(path) if asset_kind(path) is AssetKind.MJCF else {}
    names: list[str | None] = []
    for joint, name in enumerate(joints):
        count = sum(part.joint_dof_dim[joint])
        if part.joint_type[joint] not in _ONE_TO_ONE:
            names += [None] * count
        elif count == 1:
            names.append(name)
        else:
            names += together.get(name) or [f"{name}:{k}" for k in range(count)]
    return names


def _joints_by_body(path: Path) -> dict[str, list[str]]:
    """Newton's name of a body's joints taken together → their own names, slides before hinges as Newton orders them."""
    import mujoco

    found = {}
    for body in mujoco.MjSpec.from_file(str(path)).bodies:
        if len(body.joints) > 1:
            slides = [j.name for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_SLIDE]
            hinges = [j.name for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE]
            found["_".join(j.name for j in body.joints)] = slides + hinges
    return found
