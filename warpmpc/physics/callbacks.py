# SPDX-License-Identifier: Apache-2.0
"""MuJoCo's callbacks (``mjcb_control``, ...), which change its physics for a whole process and do not change ours."""

import mujoco

_GETTERS = {
    name.removeprefix("get_"): getattr(mujoco, name)
    for name in sorted(vars(mujoco))
    if name.startswith("get_mjcb_") and name != "get_mjcb_time"  # a clock for timers
}


def callbacks() -> str | None:
    """Return the callbacks that are installed now, in a few words; None if there are none."""
    names = [name for name, installed in _GETTERS.items() if installed() is not None]
    return f"callbacks ({', '.join(names)})" if names else None
