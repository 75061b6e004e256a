# SPDX-License-Identifier: Apache-2.0
"""Which of MuJoCo's rules apply: those of the version that is installed, where versions differ."""

import mujoco

VERSION = tuple(int(part) for part in mujoco.__version__.split(".")[:2])
"""Of the installed MuJoCo: major, minor."""
BOUNDED_FORCES_DO_NOT_DAMP = VERSION >= (4, 0)
"""The implicit step drops velocity derivatives of actuators on joints and tendons at ``actuatorfrcrange``."""
MORE_STATE = ("PLASTIC",) if VERSION >= (4, 0) else ()
"""Components that a state has besides those of 3.17, in their order."""


def yields(model: mujoco.MjModel) -> bool:
    """Return whether springs of a model deform for good, which MuJoCo has from 4.0 on."""
    return VERSION >= (4, 0) and model.nplastic > 0
