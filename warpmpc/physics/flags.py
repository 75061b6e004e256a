# SPDX-License-Identifier: Apache-2.0
"""Flags of MuJoCo's options: which are heeded, which change no state, and which are refused."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco

HEEDED = {
    "DSBL_CONSTRAINT", "DSBL_EQUALITY", "DSBL_FRICTIONLOSS", "DSBL_LIMIT", "DSBL_CONTACT", "DSBL_SPRING", "DSBL_DAMPER",
    "DSBL_GRAVITY", "DSBL_CLAMPCTRL", "DSBL_FILTERPARENT", "DSBL_ACTUATION", "DSBL_REFSAFE", "DSBL_SENSOR",
    "DSBL_EULERDAMP", "DSBL_MULTICCD", "ENBL_OVERRIDE",
}  # fmt: skip
"""Flags that the step follows."""
WITHOUT_EFFECT = {
    "DSBL_WARMSTART", "DSBL_MIDPHASE", "DSBL_NATIVECCD", "DSBL_AUTORESET", "DSBL_ISLAND", "ENBL_ENERGY", "ENBL_FWDINV",
    "ENBL_INVDISCRETE",
}  # fmt: skip
"""Flags that change how MuJoCo computes a step and what it reports, but not where a converged step ends."""
REFUSED = {"ENBL_SLEEP", "ENBL_DIAGEXACT", "ENBL_IPC", "ENBL_SPECULATIVE"}
"""Flags whose physics is lacking; so is that of flags that this list does not know."""


def lacking_flags(model: mujoco.MjModel) -> Iterator[str]:
    """Names of the flags that are set in a model and refused."""
    for kind, bits in ((mujoco.mjtDisableBit, model.opt.disableflags), (mujoco.mjtEnableBit, model.opt.enableflags)):
        names = {int(bit): name.removeprefix("mj") for name, bit in kind.__members__.items() if "BL_" in name}
        for bit in (1 << n for n in range(31) if bits >> n & 1):
            name = names.get(bit, f"{kind.__name__} {bit}")
            if name not in HEEDED | WITHOUT_EFFECT:
                yield name
