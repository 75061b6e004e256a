# SPDX-License-Identifier: Apache-2.0
"""Checks of what an asset may not say, although it can be read: numbers that are none, limits the wrong way round."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..scene.errors import SceneError

if TYPE_CHECKING:
    from ..scene.schema import Scene
    from .layout import Layout


def validate_layout(layout: Layout, scene: Scene) -> None:
    """Refuse a layout no state can be planned from.

    Raises:
        SceneError: If a number in it is not finite, or the lower limit of a joint lies above the upper one.
    """
    places = layout.joint_pose_parent, layout.joint_pose_child
    for j, name in enumerate(layout.joint_name):
        first_q, first_v = int(layout.joint_q_start[j]), int(layout.joint_qd_start[j])
        dofs = slice(first_v, first_v + int(layout.joint_dof_dim[j].sum()))
        end = int(layout.joint_q_start[j + 1]) if j + 1 < len(layout.joint_q_start) else layout.nq
        for what, values in (
            ("start", layout.joint_q[first_q:end]),
            ("start velocity", layout.joint_qd[dofs]),
            ("place", np.array([place[j] for place in places])),
        ):
            if not np.isfinite(values).all():
                raise _invalid(f"the {what} of joint '{name}' is not finite", name, scene)
        if np.isnan(layout.dof_lower[dofs]).any() or np.isnan(layout.dof_upper[dofs]).any():
            raise _invalid(f"a limit of joint '{name}' is no number", name, scene)
        if np.any(layout.dof_lower[dofs] > layout.dof_upper[dofs]):
            raise _invalid(f"the lower limit of joint '{name}' is above its upper one", name, scene)
    for name, centre in zip(layout.body_name, layout.body_com, strict=True):
        if not np.isfinite(centre).all():
            raise _invalid(f"the centre of mass of '{name}' is not finite", name, scene)


def _invalid(message: str, name: str, scene: Scene) -> SceneError:
    """The error for a joint or body, by the robot that its name begins with."""
    owner = next((r for r in scene.robot if name.startswith(f"{r.name}/")), scene.robot[0])
    return SceneError(message, key=f"robot.{owner.name}.asset", file=scene.path, found=owner.asset)
