# SPDX-License-Identifier: Apache-2.0
"""Which of MuJoCo's rules apply: those of the version that is installed, where versions differ."""

import mujoco

VERSION = tuple(int(part) for part in mujoco.__version__.split(".")[:2])
"""Of the installed MuJoCo: major, minor."""
BOUNDED_FORCES_DO_NOT_DAMP = VERSION >= (4, 0)
"""The implicit step drops velocity derivatives of actuators on a joint or tendon whose ``actuatorfrcrange`` bounds them."""
