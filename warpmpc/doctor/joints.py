# SPDX-License-Identifier: Apache-2.0
"""Findings about joints, servos and motors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..scene.errors import some
from .subject import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .subject import Subject

HINGE, FREE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_FREE)
DEGREE = float(np.degrees(1.0))

TURNS = 8.0 * np.pi
"""Range of a hinge from which it is more likely written in degrees and read as radians [rad]: four turns."""
SLIGHT = 0.1
"""Range of a hinge below which it is more likely written in radians and read as degrees [rad]: 6°; a full turn of 2π
read as degrees is .11."""
FEW, WEAK = 2, 10.0
"""Robots with as few driven joints are often meant to swing up: weak from this many times their force."""


def joint_findings(subject: Subject) -> Iterator[Finding]:
    """Ranges in the wrong unit, starts outside ranges, servos that ask for what joints cannot do, weak motors."""
    yield from _ranges(subject)
    yield from _starts(subject)
    yield from _servos(subject)
    yield from _gains(subject)
    yield from _strength(subject)


def _limited(model: mujoco.MjModel) -> np.ndarray:
    """Joints with limits that are hinges or slides."""
    return np.flatnonzero(model.jnt_limited.astype(bool) & (model.jnt_type >= 2))


def _ranges(subject: Subject) -> Iterator[Finding]:
    model = subject.world.model
    hinges = [j for j in _limited(model) if model.jnt_type[j] == HINGE]
    width = {j: float(np.ptp(model.jnt_range[j])) for j in hinges}
    wide = [j for j in hinges if TURNS < width[j] < 4.0 * 360.0]
    slight = [j for j in hinges if 0.0 < width[j] < SLIGHT]
    if wide:
        lower, upper = model.jnt_range[wide[0]]
        yield Finding(
            subject.asset_key(model.joint(wide[0]).name),
            f"hinge {some([model.joint(j).name for j in wide])} may turn from {lower:.4g} to {upper:.4g} rad",
            'a range in degrees needs <compiler angle="degree"/> in MJCF, and radians in URDF',
        )
    if slight and 2 * len(slight) >= len(hinges):
        lower, upper = np.degrees(model.jnt_range[slight[0]])
        yield Finding(
            subject.asset_key(model.joint(slight[0]).name),
            f"hinge {some([model.joint(j).name for j in slight])} may turn from {lower:.3g}° to {upper:.3g}° only",
            'MJCF reads angles as degrees: give <compiler angle="radian"/> if the file has radians',
        )


def _starts(subject: Subject) -> Iterator[Finding]:
    model, data = subject.world.model, subject.start
    outside = []
    for j in _limited(model):
        at, (lower, upper) = float(data.qpos[model.jnt_qposadr[j]]), model.jnt_range[j]
        if max(lower - at, at - upper) > 0.02 * max(upper - lower, 1e-6):
            outside.append((model.joint(j).name, at, lower, upper))
    if outside:
        name, at, lower, upper = outside[0]
        hint = ": is it in degrees?" if abs(at) > 2.0 * np.pi else ""
        yield Finding(
            f"{subject.asset_key(name)}.joint_q",
            f"{some([item[0] for item in outside])} starts at {at:.4g}, outside its range of {lower:.4g} to {upper:.4g}"
            + hint,
            "give joint_q a posture within the ranges, or a keyframe",
        )


def _servos(subject: Subject) -> Iterator[Finding]:
    """Position servos of MJCF files whose control range has little to do with their hinge's range.

    Grippers on slides are often sent far beyond their range, for the force.
    """
    model = subject.world.model
    far = []
    for a in range(model.nu):
        j = int(model.actuator_trnid[a, 0])
        position = model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE and model.actuator_biasprm[a, 1] < 0.0
        plain = model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_gear[a, 0] != 0.0
        same_unit = np.isclose(model.actuator_gainprm[a, 0], -model.actuator_biasprm[a, 1])
        hinge = plain and model.jnt_type[j] == HINGE and model.jnt_limited[j]
        if not (position and same_unit and model.actuator_ctrllimited[a] and hinge):
            continue
        low, high = sorted(model.actuator_ctrlrange[a] / model.actuator_gear[a, 0])
        lower, upper = model.jnt_range[j]
        ratio = (high - low) / max(upper - lower, 1e-9)
        if not 0.05 < ratio < 20.0 or high < lower or low > upper:
            sign = model.actuator_gear[a, 0] < 0.0 and -high < upper and -low > lower
            far.append((model.actuator(a).name, low, high, model.joint(j).name, lower, upper, sign))
    if far:
        name, low, high, joint, lower, upper, sign = far[0]
        degrees = ": is one of them in degrees?" if 0.3 < (high - low) / (upper - lower) / DEGREE < 3.0 else ""
        cure = 'give ctrlrange in radians, even where joint ranges are in degrees, or inheritrange="1"'
        if sign:
            degrees, cure = ": is the sign of gear wrong?", "make gear positive, or turn the sign of ctrlrange"
        yield Finding(
            f"{subject.asset_key(name)}.asset",
            f"servo {some([item[0] for item in far])} is sent {low:.4g} to {high:.4g} where joint {joint} goes from "
            f"{lower:.4g} to {upper:.4g}{degrees}",
            cure,
        )


def _gains(subject: Subject) -> Iterator[Finding]:
    """Servos that push away from where they are sent, and joints that damping speeds up."""
    model = subject.world.model
    for a in range(model.nu):
        if model.actuator_biastype[a] != mujoco.mjtBias.mjBIAS_AFFINE:
            continue
        name, bias = model.actuator(a).name, model.actuator_biasprm[a]
        if bias[1] > 0.0 or bias[2] > 0.0 or (bias[1] < 0.0 and model.actuator_gainprm[a, 0] < 0.0):
            yield Finding(
                f"{subject.asset_key(name)}.asset",
                f"servo {name} pushes away from where it is sent: gains have the wrong sign",
                "kp and kv are positive",
            )
    wrong = [model.joint(int(model.dof_jntid[i])).name for i in range(model.nv) if model.dof_damping[i] < 0.0]
    if wrong:
        yield Finding(
            f"{subject.asset_key(wrong[0])}.asset", f"joint {some(wrong)} has negative damping", "make damping positive"
        )


def _strength(subject: Subject) -> Iterator[Finding]:
    """Joints of robots with a fixed root whose motors cannot hold the start posture against gravity."""
    model, data = subject.world.model, subject.start
    force = np.zeros(model.nv)
    for a in range(model.nu):
        if model.actuator_trntype[a] != mujoco.mjtTrn.mjTRN_JOINT:
            return  # tendons and sites spread forces over joints
        dof = int(model.jnt_dofadr[model.actuator_trnid[a, 0]])
        limits = model.actuator_forcerange[a] if model.actuator_forcelimited[a] else (-np.inf, np.inf)
        if model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE and model.actuator_ctrllimited[a]:
            limits = np.clip(model.actuator_gainprm[a, 0] * model.actuator_ctrlrange[a], *limits)
        force[dof] += abs(model.actuator_gear[a, 0]) * float(np.max(np.abs(limits)))
    limited = model.jnt_actfrclimited.astype(bool)
    for j in np.flatnonzero(limited & (model.jnt_type >= 2)):
        dof = int(model.jnt_dofadr[j])
        force[dof] = min(force[dof], float(np.max(np.abs(model.jnt_actfrcrange[j]))))
    floating = {int(model.body_rootid[model.jnt_bodyid[j]]) for j in range(model.njnt) if model.jnt_type[j] == FREE}
    still = mujoco.MjData(model)
    still.qpos = data.qpos
    mujoco.mj_forward(model, still)
    weak, short = [], 1.0 if np.count_nonzero(force) > FEW else WEAK
    for j in range(model.njnt):
        dof, root = int(model.jnt_dofadr[j]), int(model.body_rootid[model.jnt_bodyid[j]])
        need = abs(float(still.qfrc_bias[dof] - still.qfrc_passive[dof]))
        if model.jnt_type[j] >= 2 and root not in floating and 0.0 < short * force[dof] < need:
            weak.append((model.joint(j).name, need, force[dof], model.jnt_type[j] == HINGE))
    if weak:
        name, need, there, hinge = weak[0]
        unit = "N·m" if hinge else "N"
        yield Finding(
            f"{subject.asset_key(name)}.drive",
            f"joint {some([item[0] for item in weak])} needs {need:.3g} {unit} to hold the start against gravity and "
            f"has {there:.3g} {unit}",
            "check masses (kilograms), effort limits, and whether gravity_compensation is meant",
        )
