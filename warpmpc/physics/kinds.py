# SPDX-License-Identifier: Apache-2.0
"""Kinds of actuators, tendons' ways and equalities, by the names of MuJoCo's enumerations: read, or refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import mujoco

if TYPE_CHECKING:
    from collections.abc import Iterator


class Kinds(NamedTuple):
    """One enumeration."""

    what: str
    array: str
    """Of the model."""
    enum: type
    read: str
    refused: str
    """The other names: those of callbacks, plugins and deformable bodies, and what is not written yet."""


KINDS = (
    Kinds("dynamics of actuators", "actuator_dyntype", mujoco.mjtDyn, "NONE INTEGRATOR FILTER FILTEREXACT MUSCLE",
          "PID DCMOTOR USER"),
    Kinds("gains of actuators", "actuator_gaintype", mujoco.mjtGain, "FIXED AFFINE MUSCLE", "PID DCMOTOR SO3 USER"),
    Kinds("biases of actuators", "actuator_biastype", mujoco.mjtBias, "NONE AFFINE MUSCLE", "DCMOTOR SO3 USER"),
    Kinds("transmissions of actuators", "actuator_trntype", mujoco.mjtTrn,
          "JOINT JOINTINPARENT TENDON SITE SLIDERCRANK",
          "BODY SO3 UNDEFINED"),
    Kinds("ways of tendons", "wrap_type", mujoco.mjtWrap, "JOINT PULLEY SITE SPHERE CYLINDER", "NONE"),
    Kinds("equalities", "eq_type", mujoco.mjtEq, "CONNECT WELD JOINT TENDON", "FLEX FLEXVERT FLEXSTRAIN DISTANCE"),
)  # fmt: skip


def lacking_kinds(model: mujoco.MjModel) -> Iterator[str]:
    """What a model has of kinds that are not read, in a few words each."""
    for kinds in KINDS:
        found = {_name(kinds.enum, int(kind)) for kind in getattr(model, kinds.array)}
        if unread := sorted(found - set(kinds.read.split())):
            yield f"{kinds.what}: {', '.join(unread)}"


def _name(enum: type, kind: int) -> str:
    """A member's name without that of its enumeration, or its number where this MuJoCo has none."""
    names = {int(member): name.split("_", 1)[1] for name, member in enum.__members__.items()}
    return names.get(kind, str(kind))
