# SPDX-License-Identifier: Apache-2.0
"""Which of MuJoCo's rules apply: those of the version that is installed, where versions differ."""

import mujoco

VERSION = tuple(int(part) for part in mujoco.__version__.split(".")[:2])
"""Of the installed MuJoCo: major, minor."""
SPARSE_IS_WRONG = mujoco.__version__ == "4.0.0"
"""Its solver factors Hessians of sparse models wrongly (mended in 4.0.1)."""
BOUNDED_FORCES_DO_NOT_DAMP = VERSION >= (4, 0)
"""The implicit step drops velocity derivatives of actuators on joints and tendons at ``actuatorfrcrange``."""
RULES = {"SIDES_WIND": int(VERSION >= (4, 0)), "CENTRES_MEET": int(VERSION >= (4, 0))}
"""Macros: a tendon turns about a shape as the line over the side's site does; convex shapes about one centre touch."""
MORE_STATE = ("PLASTIC",) if VERSION >= (4, 0) else ()
"""Components that a state has besides those of 3.17, in their order."""


def yields(model: mujoco.MjModel) -> bool:
    """Return whether springs of a model deform for good, which MuJoCo has from 4.0 on."""
    return VERSION >= (4, 0) and model.nplastic > 0
