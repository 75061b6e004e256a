# SPDX-License-Identifier: Apache-2.0
"""A compiled scene: its MuJoCo model and the layout of its state."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

    from .layout import Layout
    from .mjcf import MjcfRobot


@dataclass(frozen=True)
class CompiledScene:
    """One world of a scene as the MuJoCo engine needs it."""

    layout: Layout
    mjcf: str
    """The MuJoCo model that ``SolverMuJoCo`` compiles from the Newton model without MJCF robots, as XML with meshes
    inline; empty where there is nothing else."""
    body_name: tuple[str, ...]
    """MuJoCo name of each Newton body."""
    geom_name: tuple[str, ...]
    """MuJoCo name of each shape, empty for shapes that do not collide."""
    joint_name: tuple[str, ...]
    """MuJoCo name of each joint dof."""
    actuator_name: tuple[str, ...] = ()
    """Actuator of an MJCF file behind each control, empty for controls of drives."""
    mjcf_robots: tuple[MjcfRobot, ...] = ()
    """The MJCF robots, whose files go into the MuJoCo model as they are."""
    notes: tuple[str, ...] = ()
    """Parts of MJCF files that were taken over, and those that were not."""
    timestep: float | None = None
    """Physics step that the first MJCF file asks for [s]."""
    repaired: tuple[str, ...] = ()
    """Repairs of the assets, which are warned of every time."""
    measured: dict[str, int] = field(init=False, default_factory=dict, compare=False, repr=False)
    """Numbers of physics steps that were found for it by rolling it out."""

    def spec(self) -> mujoco.MjSpec:
        """The MuJoCo model of the scene, to be compiled."""
        from .compose import compose

        shapes = zip(self.layout.shapes, self.geom_name, strict=True)
        return compose(self.mjcf, self.mjcf_robots, {name for shape, name in shapes if name and shape.collides})

    def substeps(self, wanted: int | None, control_dt: float, default: int) -> int:
        """Physics steps per control.

        Args:
            wanted: What the scene says.
            control_dt: Length of a control [s].
            default: What holds where neither the scene nor an MJCF file says anything.
        """
        if wanted is not None:
            return wanted
        return default if self.timestep is None else max(1, round(control_dt / self.timestep))
