# SPDX-License-Identifier: Apache-2.0
"""Names of single joint axes where a joint of Newton's has several."""

from __future__ import annotations

from typing import TYPE_CHECKING

from newton import JointType

if TYPE_CHECKING:
    import newton

_ONE_TO_ONE = (JointType.PRISMATIC, JointType.REVOLUTE, JointType.D6)


def axis_names(part: newton.ModelBuilder, joints: list[str]) -> list[str | None]:
    """Name of every joint velocity of a robot, None for those of free and ball joints.

    A joint of one axis gives its own name; the axes of one that has several are numbered, ``joint:0``.

    Args:
        part: The robot's builder.
        joints: Name of each joint.
    """
    names: list[str | None] = []
    for joint, name in enumerate(joints):
        count = sum(part.joint_dof_dim[joint])
        if part.joint_type[joint] not in _ONE_TO_ONE:
            names += [None] * count
        elif count == 1:
            names.append(name)
        else:
            names += [f"{name}:{k}" for k in range(count)]
    return names
