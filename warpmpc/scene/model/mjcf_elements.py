# SPDX-License-Identifier: Apache-2.0
"""Inertias and limits of an MJCF file that MuJoCo refuses: repaired, or said with a cure.

The actuators of an MJCF file that a scene's drives replace: the largest forces that their joints get from them.

Keyframes of an MJCF file, by names.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .urdf_physics import nearest_inertia

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from newton import ModelBuilder

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


def keep_total_mass(spec: mujoco.MjSpec) -> None:
    """Give bodies the masses that ``settotalmass`` asks for, which MuJoCo drops where a file is a part of a model."""
    if spec.compiler.settotalmass <= 0.0:
        return
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "compiler attribute 'settotalmass' is deprecated")
        model = spec.copy().compile()
    for body in spec.bodies[1:]:
        whole = model.body(body.name)
        body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
        body.mass, body.inertia, body.ipos, body.iquat = whole.mass[0], whole.inertia, whole.ipos, whole.iquat
    compiler = spec.compiler
    compiler.settotalmass, compiler.boundmass, compiler.boundinertia = -1.0, 0.0, 0.0
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE


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


_ON_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_FOLLOW = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
"""Dynamics whose activation stays within the range of the control."""


def motor_limits(spec: mujoco.MjSpec) -> dict[str, float]:
    """Largest force of each joint's own actuators [N or N·m]; joints of which the file tells none are left out.

    A motor's is that of its ``ctrlrange``, any actuator's that of its ``forcerange``, both times its gear.
    """
    most: dict[str, float] = {}
    for actuator in spec.actuators:
        if actuator.trntype in _ON_JOINT:
            force = abs(float(actuator.gear[0])) * _force(spec, actuator)
            most[actuator.target] = most.get(actuator.target, 0.0) + force
    return {joint: force for joint, force in most.items() if np.isfinite(force) and force > 0.0}


def _force(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> float:
    """Largest force of an actuator before its gear; infinite where nothing bounds it."""
    force = np.inf
    if _limited(spec, actuator.forcelimited, actuator.forcerange):
        force = float(np.abs(actuator.forcerange).max())
    plain = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
    if plain and actuator.dyntype in _FOLLOW and _limited(spec, actuator.ctrllimited, actuator.ctrlrange):
        force = min(force, float(np.abs(actuator.gainprm[0] * actuator.ctrlrange).max()))
    return force


def _limited(spec: mujoco.MjSpec, limited: int, bounds: np.ndarray) -> bool:
    if limited == mujoco.mjtLimited.mjLIMITED_AUTO:
        return spec.compiler.autolimits and bool(bounds[0] < bounds[1])
    return limited == mujoco.mjtLimited.mjLIMITED_TRUE


def keep_limits(part: ModelBuilder, axes: list[str | None], limits: Mapping[str, float]) -> None:
    """Let the drives of a robot give joints no more force than its own actuators did, unless they say how much."""
    for dof, name in enumerate(axes):
        if name in limits:
            part.joint_effort_limit[dof] = min(part.joint_effort_limit[dof], limits[name])


def replaced_words(spec: mujoco.MjSpec, limits: Mapping[str, float]) -> Iterator[str]:
    """Lines on the actuators that drives replace.

    Args:
        spec: The file with its actuators.
        limits: Their :func:`motor_limits`.
    """
    if not len(spec.actuators):
        return
    slides = {joint.name for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_SLIDE}
    alike: dict[tuple[float, str], list[str]] = {}
    for joint, force in limits.items():
        alike.setdefault((force, "N" if joint in slides else "N·m"), []).append(joint)
    listed = "; ".join(f"{force:g} {unit} {', '.join(names)}" for (force, unit), names in alike.items())
    forces = f", which had at most {listed}: drives without effort_limit have as much" if listed else ""
    yield f"its own actuators are replaced by the scene's drive{forces}"
    targets = {actuator.target for actuator in spec.actuators if actuator.trntype in _ON_JOINT}
    if unknown := sorted(targets - limits.keys()):
        yield f"the file tells no limit of the actuators on {', '.join(unknown)}: give the drive an effort_limit"
    if elsewhere := [actuator.name for actuator in spec.actuators if actuator.trntype not in _ON_JOINT]:
        yield f"its actuators {', '.join(elsewhere)} act on no joint: no limit of a drive is taken from them"
    for what in ("armature", "damping"):
        if any(np.any(getattr(actuator, what, 0.0)) for actuator in spec.actuators):
            yield f"{what} of its actuators is not taken over: give the joints {what} in the file"


@dataclass(frozen=True)
class Key:
    """A keyframe by names, in MuJoCo's conventions and in the file's own frame."""

    name: str
    qpos: dict[str, tuple[float, ...]]
    """Joint → its coordinates."""
    qvel: dict[str, tuple[float, ...]]
    act: dict[str, tuple[float, ...]]
    """Actuator → its activations."""
    ctrl: dict[str, float]
    mocap: dict[str, tuple[float, ...]]
    """Mocap body → its pose (x, y, z, qx, qy, qz, qw)."""


def take_keys(spec: mujoco.MjSpec) -> tuple[Key, ...]:
    """Keyframes by names; they leave the file, since their rows fit its own joints and actuators alone."""
    if not spec.keys:
        return ()
    model = spec.compile()
    found = tuple(_key(model, k) for k in range(model.nkey))
    for key in list(spec.keys):
        spec.delete(key)
    return found


_WIDTHS = {0: (7, 6), 1: (4, 3), 2: (1, 1), 3: (1, 1)}
"""Coordinates and velocities of MuJoCo's joint types."""


def _key(model: mujoco.MjModel, k: int) -> Key:
    def row(values, start: int, width: int) -> tuple[float, ...]:
        return tuple(float(x) for x in values[k, start : start + width])

    joints = [(model.joint(j).name, _WIDTHS[int(model.jnt_type[j])], j) for j in range(model.njnt)]
    actuators = [(model.actuator(a).name, a) for a in range(model.nu)]
    mocap = {}
    for body in range(model.nbody):
        m = model.body_mocapid[body]
        if m >= 0:
            w, x, y, z = row(model.key_mquat, 4 * m, 4)
            mocap[model.body(body).name] = (*row(model.key_mpos, 3 * m, 3), x, y, z, w)
    return Key(
        name=model.key(k).name,
        qpos={name: row(model.key_qpos, model.jnt_qposadr[j], width[0]) for name, width, j in joints},
        qvel={name: row(model.key_qvel, model.jnt_dofadr[j], width[1]) for name, width, j in joints},
        act={
            name: row(model.key_act, model.actuator_actadr[a], model.actuator_actnum[a])
            for name, a in actuators
            if model.actuator_actnum[a]
        },
        ctrl={name: float(model.key_ctrl[k, a]) for name, a in actuators},
        mocap=mocap,
    )
