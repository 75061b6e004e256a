# SPDX-License-Identifier: Apache-2.0
"""A table of joints: where each may go and where it starts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich import box
from rich.table import Table

if TYPE_CHECKING:
    from ..model.layout import Layout

_UNLIMITED = 1e3
"""Width from which a range counts as no limit [m or rad]."""


def joint_table(layout: Layout, joint_q: np.ndarray | None = None) -> Table:
    """The table of all hinges and slides: range and start, of hinges in degrees besides.

    Args:
        layout: State layout.
        joint_q: Joint coordinates ``[nq]`` that are shown in place of the start.
    """
    middle, coordinates = ("start", layout.joint_q) if joint_q is None else ("now", joint_q)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("joint")
    for name in ("lower", middle, "upper"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("unit")
    table.add_column("in degrees")
    for dof, name in enumerate(layout.dof_name):
        if not name:
            continue
        lower, upper, start = layout.dof_lower[dof], layout.dof_upper[dof], coordinates[layout.dof_coord[dof]]
        limited = upper - lower < _UNLIMITED
        numbers = [lower if limited else -np.inf, start, upper if limited else np.inf]
        joint = int(np.flatnonzero(layout.joint_qd_start <= dof)[-1])
        hinge = bool(dof - int(layout.joint_qd_start[joint]) >= int(layout.joint_dof_dim[joint, 0]))
        outside = limited and not lower <= start <= upper
        table.add_row(
            name,
            *(f"{number:.4g}" for number in numbers),
            "rad" if hinge else "m",
            (" ".join(f"{np.degrees(number):.0f}" for number in numbers) if hinge else "") + " outside" * bool(outside),
        )
    return table
