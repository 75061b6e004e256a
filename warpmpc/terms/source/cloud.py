# SPDX-License-Identifier: Apache-2.0
"""Source of ``cloud_collision``: one gather for a sphere, or eight."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...bake.lines import Operand, literal
from .collision import GroupCode, groups_of
from .volume import Grid, between, nearest

if TYPE_CHECKING:
    from ...cost.code.state import TermCode


def cloud_collision(code: TermCode, p: Any) -> Operand:
    """``cloud.cloud_collision``; a link is looked at where the sphere around it is near for any of the samples."""
    volume, margin, allowance = p.volume, f"{code.params}.margin", f"{code.params}.allowance"
    groups, add = groups_of(code, p.spheres), code.lines.add
    least = code.variable("least", f"(T){margin}")
    grid = Grid(tuple(volume.origin), float(volume.inverse), (volume.nx, volume.ny, volume.nz))
    look = between if p.between else nearest
    voxels = volume.nx * volume.ny * volume.nz
    add(f"{{ const float* vol = (const float*){code.params}.volume.distance.data + (size_t)e * {voxels};")
    for group in groups:
        _group(code, group, grid, look, least, margin, allowance)
    add("}")
    if p.binary:
        return code.lines.let(f"VSELECT({least} < {margin}, 1.0f, 0.0f)")
    return code.lines.let(f"{margin} - {least}")


def _group(code: TermCode, group: GroupCode, grid: Grid, look: Any, least: str, margin: str, allowance: str) -> None:
    """Least distance of the spheres of a link; ``d`` is what the volume says."""
    add = code.lines.add
    add("{")
    if group.count > 1:
        # the voxel's own distance, which differs from that at the point by half its diagonal at most
        reach = group.radius + 0.5 * 3.0**0.5 / grid.inverse
        add(f"T d = {_FAR}; {nearest(group.bound, grid)}")
        add(f"if (VANY(d < {literal(reach)} + {margin} + {allowance})) {{")
    for radius, centres in group.classes.items():
        add(f"{{ T d = {_FAR};")
        code.lines.statements.extend(look(centre, grid) for centre in centres)
        add(f"{least} = VMIN({least}, d - {literal(radius)} - {allowance}); }}")
    add("} }" if group.count > 1 else "}")


_FAR = "((T)1.0e6f)"
