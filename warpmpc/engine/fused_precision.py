# SPDX-License-Identifier: Apache-2.0
"""Numbers of a model that are too large for single precision, in the words of a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..scene.errors import SceneError

if TYPE_CHECKING:
    from ..bake.lines import OutOfRange
    from ..model.layout import Layout
    from ..model.mujoco_model import MujocoWorld
    from ..scene.schema import Scene

LARGE = 1e15
"""Numbers from here on are named: their squares overflow with a few factors more."""
_NUMBERS = {
    "body_mass": "mass",
    "body_inertia": "moment of inertia",
    "geom_size": "size",
    "dof_armature": "armature",
    "dof_damping": "damping",
    "dof_frictionloss": "dry friction",
    "jnt_stiffness": "stiffness",
    "actuator_gainprm": "gain",
    "actuator_biasprm": "gain",
    "actuator_gear": "gear",
}
"""Arrays of a MuJoCo model, and what one of their numbers is called; causes stand before what follows from them."""


def refusal(error: OutOfRange, scene: Scene, world: MujocoWorld, layout: Layout) -> SceneError:
    """The error for a model with a number that is too large, which it names where it is found."""
    message = f"the engine fused: {error}"
    for array, what in _NUMBERS.items():
        rows = getattr(world.model, array)
        largest = np.abs(rows).reshape(len(rows), -1).max(axis=1, initial=0.0)
        owner = _owner(world, array, int(largest.argmax())) if (largest > LARGE).any() else None
        if owner is not None:
            message += f", and '{owner}' has {largest.max():g} as its {what}: lower it, or take the engine mujoco"
            return SceneError(message, key=f"{layout.entity(owner).kind}.{owner}", file=scene.path)
    return SceneError(message, key="engine.name", file=scene.path, allowed=["auto", "mujoco", "newton"])


def _owner(world: MujocoWorld, array: str, row: int) -> str | None:
    """Robot, object or obstacle that a row of an array of the model belongs to; None where there is none."""
    m = world.model
    if array.startswith("body"):
        body = row
    elif array.startswith("actuator"):
        kind = int(m.actuator_trntype[row])
        joint = kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        body = int(m.jnt_bodyid[m.actuator_trnid[row, 0]]) if joint else -1
    else:
        body = int(getattr(m, f"{array.partition('_')[0]}_bodyid")[row])
    return next((name for name, bodies in world.bodies.items() if body in bodies), None)
