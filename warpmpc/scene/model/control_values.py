# SPDX-License-Identifier: Apache-2.0
"""Limits of controls that a scene leaves to its assets: what they say of joints and actuators.

The command that is safe without a plan, as each drive is.

Controls that hold the start state: hover of a drone, gravity compensation of an arm with motors.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from ..errors import SceneError
from ..schema import Drive, DriveMode, Scene
from .conversion import StateRows
from .mujoco_model import make_world

if TYPE_CHECKING:
    import newton

    from .compiled_scene import CompiledScene
    from .layout import Layout

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


def safe_command(layout: Layout, joint_q: np.ndarray, joint_qd: np.ndarray, control_dt: float) -> np.ndarray:
    """The position given, a stop by the next control, or what holds the start, as the drive is ``[n, nu]``.

    The last is ``control_start``: the controls of an MJCF file's keyframe, else an equilibrium; zero where there is
    none. Limits are the caller's.

    Args:
        layout: State layout.
        joint_q: Joint coordinates ``[n, nq]`` [m, rad].
        joint_qd: Joint velocities ``[n, nv]`` [m/s, rad/s].
        control_dt: Time in which drives of accelerations come to a stop [s].
    """
    held, brake = layout.control_safe, layout.control_brake
    rest = layout.control_start if len(layout.control_start) else 0.0
    safe = np.where(held >= 0, joint_q[:, np.maximum(held, 0)], rest)
    return np.where(brake >= 0, -joint_qd[:, np.maximum(brake, 0)] / control_dt, safe)


_STEP = 0.002
"""Physics step of the model [s]; an equilibrium has none, servos of velocity are told one."""
_LEFT = 0.3
"""Share of the start's acceleration that may be left: an equilibrium leaves none, a robot in free fall all of it, and
a drone under a load that swings little."""


def with_equilibrium(compiled: CompiledScene) -> CompiledScene:
    """The scene with ``control_start`` that holds its start, where there is such a control and no keyframe has one.

    Position servos stay at their posture; the other controls come from inverse dynamics (MuJoCo's ``mj_inverse`` at
    zero acceleration) by least squares within their limits.
    """
    layout = compiled.layout
    free = np.flatnonzero((layout.control_safe < 0) & (layout.control_brake < 0))
    if layout.control_start.any() or not len(free) or not layout.nv:
        return compiled
    world = make_world(compiled, timestep=_STEP)
    model, data = world.model, mujoco.MjData(world.model)
    state = StateRows(layout, world)(layout.joint_q[None], np.zeros((1, layout.nv)), None)[0]
    data.qpos = state[: model.nq]
    safe = safe_command(layout, layout.joint_q[None], np.zeros((1, layout.nv)), 1.0)[0]

    def force(control: np.ndarray) -> np.ndarray:
        """Generalized forces of all actuators ``[nv]``."""
        data.ctrl = world.actuator_matrix @ control + world.actuator_offset
        mujoco.mj_forward(model, data)
        return data.qfrc_actuator.copy()

    without = force(safe)
    each = np.stack([force(safe + unit) - without for unit in np.eye(layout.nu)[free]], axis=1)
    data.qacc = 0.0
    mujoco.mj_inverse(model, data)
    moved = np.isin(model.dof_treeid, model.dof_treeid[np.abs(each).max(axis=1) > 0.0])
    if not moved.any():
        return compiled
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    root = np.linalg.cholesky(mass[np.ix_(moved, moved)])  # the error is an acceleration, weighed by kinetic energy
    wanted = solve_triangular(root, (data.qfrc_inverse - without)[moved], lower=True)
    matrix = solve_triangular(root, each[moved], lower=True)
    scale = np.linalg.norm(wanted)
    if scale < 1e-6:
        return compiled
    found = lsq_linear(matrix, wanted, bounds=(layout.control_lower[free], layout.control_upper[free]))
    if np.linalg.norm(matrix @ found.x - wanted) > _LEFT * scale:
        return compiled
    control = np.zeros(layout.nu, dtype=np.float32)
    control[free] = found.x
    return replace(compiled, layout=replace(layout, control_start=control))


def actuator_words(model: mujoco.MjModel, a: int) -> str:
    """Kind of an actuator, by MuJoCo's shortcuts, and what it acts on."""
    kinds = mujoco.mjtTrn
    names = {
        kinds.mjTRN_JOINT: ("joint", model.joint),
        kinds.mjTRN_JOINTINPARENT: ("joint", model.joint),
        kinds.mjTRN_TENDON: ("tendon", model.tendon),
        kinds.mjTRN_SITE: ("site", model.site),
        kinds.mjTRN_SLIDERCRANK: ("slider-crank", model.site),
        kinds.mjTRN_BODY: ("body", model.body),
    }
    kind, find = names[mujoco.mjtTrn(int(model.actuator_trntype[a]))]
    gain, bias = model.actuator_gainprm[a, 0], model.actuator_biasprm[a]
    if kind == "body":
        shortcut = "adhesion"
    elif model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_MUSCLE:
        shortcut = "muscle"
    elif model.actuator_gaintype[a] != mujoco.mjtGain.mjGAIN_FIXED:
        shortcut = "general"
    elif model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE:
        shortcut = "motor"
    else:
        shortcut = "position" if bias[1] == -gain else "velocity" if bias[2] == -gain else "general"
    return f"{shortcut} at {kind} {find(int(model.actuator_trnid[a, 0])).name}"


def effort_words(model: mujoco.MjModel, a: int) -> str:
    """Largest force of an actuator of an MJCF file, at its joint if it acts on one; - without a limit."""
    limits, unit = [], ""
    gear, joint = abs(model.actuator_gear[a, 0]), int(model.actuator_trnid[a, 0])
    if mujoco.mjtTrn(int(model.actuator_trntype[a])).name not in ("mjTRN_JOINT", "mjTRN_JOINTINPARENT"):
        gear = 1.0
    elif kind := {"mjJNT_SLIDE": "N", "mjJNT_HINGE": "N·m"}.get(mujoco.mjtJoint(int(model.jnt_type[joint])).name):
        unit = f" {kind}"
        limits += [np.abs(model.jnt_actfrcrange[joint]).max()] * bool(model.jnt_actfrclimited[joint])
    limits += [gear * np.abs(model.actuator_forcerange[a]).max()] * bool(model.actuator_forcelimited[a])
    return f"{min(limits):g}{unit}" if limits else "-"
