# SPDX-License-Identifier: Apache-2.0
"""Inertias and limits of an MJCF file that MuJoCo refuses: repaired, or said with a cure."""

from __future__ import annotations

import re

import mujoco
import numpy as np

from .urdf_physics import nearest_inertia

_TRIANGLE = 1e-9
"""Share of an inertia by which A + B ≥ C may miss before it is repaired."""
_AXES = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
"""Rows and columns of the six numbers of ``fullinertia``."""

_CURES = {
    "mass and inertia of moving bodies must be larger than mjMINVAL": (
        "it moves, and its mass or an inertia is not above zero: give it an <inertial>, a geom that weighs something, "
        "or no joint"
    ),
    "range[0] should be smaller than range[1]": (
        "its range must begin below its end: correct range, or leave limited out where it has none"
    ),
    "actfrcrange[0] should be smaller than actfrcrange[1]": (
        "its actuatorfrcrange must begin below its end: correct it, or leave actuatorfrclimited out where it has none"
    ),
    "axis too small": "its axis has no length: give it one",
    "must be positive in geom": "its sizes must be above zero: correct size",
    "invalid control range": "its ctrlrange must begin below its end: correct it, or leave ctrllimited out",
    "invalid force range": "its forcerange must begin below its end: correct it, or leave forcelimited out",
}
"""What MuJoCo says of an element → what is wrong and what to do about it."""
_ELEMENT = re.compile(r"^(.*?);? Element name '([^']*)', id \d+(?:, line (\d+))?", re.DOTALL)


def repair_spec(spec: mujoco.MjSpec) -> list[str]:
    """Mend what stands for nothing known: inertias that no body has, limits of 0 for the force on a joint.

    Args:
        spec: The file, all bodies and joints named; changed in place.

    Returns:
        What was repaired, one line each.
    """
    inferred = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    said = []
    for body in spec.bodies[1:]:
        if body.explicitinertial and not spec.compiler.balanceinertia and not (inferred and body.geoms):
            said += _repair_inertia(body)
    for joint in spec.joints:
        if joint.actfrclimited == mujoco.mjtLimited.mjLIMITED_TRUE and not np.any(joint.actfrcrange):
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
            said.append(f"joint '{joint.name}': an actuatorfrcrange of 0 is taken as none")
    return said


def _repair_inertia(body: mujoco.MjsBody) -> list[str]:
    full = np.isfinite(body.fullinertia).all()
    given = np.diag(body.inertia).astype(float)
    if full:
        given[_AXES] = given[_AXES[::-1]] = body.fullinertia
    if not np.isfinite(given).all() or not given.any():
        return []
    least, middle, most = np.linalg.eigvalsh(given)
    if least + middle >= most * (1.0 - _TRIANGLE):
        return []
    nearest = nearest_inertia(given)
    if full:
        body.fullinertia = nearest[_AXES]
    else:
        body.inertia = np.diag(nearest)
    before, after = (", ".join(f"{x:.4g}" for x in np.linalg.eigvalsh(i)) for i in (given, nearest))
    return [f"body '{body.name}': no body has the principal inertias {before} kg·m² (A + B ≥ C); {after} are taken"]


def refusal(error: Exception) -> str:
    """MuJoCo's complaint about a file in one line, with the element, its line and the cure where one is known."""
    said = re.sub(r"\s*\n\s*", "; ", str(error).strip()).removeprefix("Error: ")
    found = _ELEMENT.match(said)
    cure = next((cure for what, cure in _CURES.items() if what in said), None)
    if found is None or cure is None:
        return said
    _, name, line = found.groups()
    return f"'{name}'" + (f" (line {line})" if line else "") + f": {cure}"
