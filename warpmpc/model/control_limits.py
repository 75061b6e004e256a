# SPDX-License-Identifier: Apache-2.0
"""Limits of controls that a scene leaves to its assets: what they say of joints and actuators."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from ..scene.errors import SceneError
from ..scene.schema import Drive, DriveMode, Scene

if TYPE_CHECKING:
    import newton

UNBOUNDED = 1e6
"""Bounds of joints from here on are Newton's way to say that there are none."""


def own_limits(model: mujoco.MjModel, a: int, *, held: bool) -> tuple[float, float] | None:
    """Bounds of the control of an actuator: its own, those of the joint that it holds, those of its force, or none.

    Args:
        model: The file's model.
        a: The actuator.
        held: Whether it holds a joint at the control.
    """
    if model.actuator_ctrllimited[a]:
        lower, upper = model.actuator_ctrlrange[a]
        return float(lower), float(upper)
    joint = int(model.actuator_trnid[a, 0])
    if held and model.jnt_limited[joint]:
        lower, upper = model.jnt_range[joint]
        return float(lower), float(upper)
    gain, plain = float(model.actuator_gainprm[a, 0]), model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
    fixed = model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
    if model.actuator_forcelimited[a] and plain and fixed and gain > 0.0:
        lower, upper = model.actuator_forcerange[a] / gain
        return float(lower), float(upper)
    return None


def asset_limits(
    part: newton.ModelBuilder, drive: Drive, joints: dict[str, int], scene: Scene, where: str
) -> tuple[list[float], list[float]]:
    """Lower and upper bounds of a drive's controls, from what the asset says of its joints.

    Args:
        part: The robot's builder.
        drive: The drive.
        joints: Joint velocity of each of its joints, by name.
        scene: The scene, for errors.
        where: Key of the drive.

    Raises:
        SceneError: If the asset says nothing of one.
    """
    what = {DriveMode.POSITION: "range", DriveMode.EFFORT: "greatest effort"}.get(drive.mode, "greatest speed")
    bounds = [_asset_bounds(part, drive, dof, i) for i, dof in enumerate(joints.values())]
    for name, (lower, upper) in zip(joints, bounds, strict=True):
        if not -UNBOUNDED < lower < upper < UNBOUNDED:
            message = f"the asset says no {what} of joint '{name}': give limit = [...]"
            raise SceneError(message, key=f"{where}.limit", file=scene.path)
    if drive.mode is DriveMode.DIFF_DRIVE:
        speed = drive.wheel_radius * min(upper for _, upper in bounds)
        bounds = [(-speed, speed), (-2.0 * speed / drive.track, 2.0 * speed / drive.track)]
    return [lower for lower, _ in bounds], [upper for _, upper in bounds]


def _asset_bounds(part: newton.ModelBuilder, drive: Drive, dof: int, i: int) -> tuple[float, float]:
    """Bounds of what a drive asks of its joint number i, as the asset says."""
    if drive.mode is DriveMode.POSITION:
        return float(part.joint_limit_lower[dof]), float(part.joint_limit_upper[dof])
    if drive.mode is DriveMode.EFFORT and drive.effort_limit is not None:
        bound = drive.effort_limit[i if len(drive.effort_limit) > 1 else 0]
    elif drive.mode is DriveMode.EFFORT:
        bound = float(part.joint_effort_limit[dof])
    else:
        bound = float(part.joint_velocity_limit[dof])
    return -bound, bound
