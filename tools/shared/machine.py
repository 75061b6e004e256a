# SPDX-License-Identifier: Apache-2.0
"""The machine that figures belong to."""

from __future__ import annotations

import os
from importlib.metadata import version

from warpmpc.scene.origin import hardware, versions


def machine() -> dict:
    """Hardware, load and versions, plain data for JSON."""
    return {**hardware(), "load": os.getloadavg(), **versions(), "mujoco-warp": version("mujoco-warp")}
