# SPDX-License-Identifier: Apache-2.0
"""Actuators of MJCF files in words."""

from __future__ import annotations

import mujoco
import numpy as np


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
