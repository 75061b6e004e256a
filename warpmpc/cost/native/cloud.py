# SPDX-License-Identifier: Apache-2.0
"""Baked source of ``cloud_collision``: one gather for a sphere, or eight."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...bake.lines import Operand, literal
from .collision import GroupCode, groups_of, variable

if TYPE_CHECKING:
    from ...bake.state import TermCode


def cloud_collision(code: TermCode, p: Any) -> Operand:
    """``cloud.cloud_collision``; a link is looked at where the sphere around it is near for any of the samples."""
    volume, margin, allowance = p.volume, f"{code.params}.margin", f"{code.params}.allowance"
    groups, add = groups_of(code, p.spheres), code.lines.add
    least = variable(code, "least", f"(T){margin}")
    look = _between if p.between else _nearest
    voxels = volume.nx * volume.ny * volume.nz
    add(f"{{ const float* vol = (const float*){code.params}.volume.distance.data + (size_t)e * {voxels};")
    for group in groups:
        _group(code, group, volume, look, least, margin, allowance)
    add("}")
    if p.binary:
        return code.lines.let(f"VSELECT({least} < {margin}, 1.0f, 0.0f)")
    return code.lines.let(f"{margin} - {least}")


def _group(code: TermCode, group: GroupCode, volume: Any, look: Any, least: str, margin: str, allowance: str) -> None:
    """Least distance of the spheres of a link; ``d`` is what the volume says."""
    add = code.lines.add
    add("{")
    if group.count > 1:
        # the voxel's own distance, which differs from that at the point by half its diagonal at most
        reach = group.radius + 0.5 * 3.0**0.5 / volume.inverse
        add(f"T d = {_FAR}; {_nearest(group.bound, volume)}")
        add(f"if (VANY(d < {literal(reach)} + {margin} + {allowance})) {{")
    for radius, centres in group.classes.items():
        add(f"{{ T d = {_FAR};")
        code.lines.statements.extend(look(centre, volume) for centre in centres)
        add(f"{least} = VMIN({least}, d - {literal(radius)} - {allowance}); }}")
    add("} }" if group.count > 1 else "}")


_FAR = "((T)1.0e6f)"


def _place(point: list[str], volume: Any, shift: float, top: float) -> str:
    """Where a point is among the voxels, ``x``, ``y``, ``z``, and their whole parts ``ix``, ``iy``, ``iz``."""
    out = []
    sizes = (volume.nx, volume.ny, volume.nz)
    for axis, at, origin, size in zip("xyz", point, volume.origin, sizes, strict=True):
        cells = f"({at} - {literal(origin)}) * {literal(volume.inverse)}" + (f" - {literal(shift)}" if shift else "")
        out.append(
            f"const T {axis} = VMIN(VMAX({cells}, 0.0f), {literal(size - top)}); const I i{axis} = VINT({axis});"
        )
    return f"{' '.join(out)} const I at = (iz * {volume.ny} + iy) * {volume.nx} + ix;"


def _nearest(point: list[str], volume: Any) -> str:
    """``volume.voxel_distance``."""
    return f"{{ {_place(point, volume, 0.0, 0.001)} d = VMIN(d, VGATHER(vol, at)); }}"


def _between(point: list[str], volume: Any) -> str:
    """``volume.between_voxels``."""
    rows = []
    for name, offset in (("a", 0), ("b", volume.nx), ("c", volume.nx * volume.ny), ("d", volume.nx * (volume.ny + 1))):
        first = f"const T {name}0 = VGATHER(vol, at + {offset});"
        rows.append(f"{first} const T {name}1 = {name}0 + fx * (VGATHER(vol, at + {offset + 1}) - {name}0);")
    parts = " ".join(f"const T f{axis} = {axis} - VFLOAT(i{axis});" for axis in "xyz")
    low, high = "const T low = a1 + fy * (b1 - a1);", "const T high = c1 + fy * (d1 - c1);"
    return (
        f"{{ {_place(point, volume, 0.5, 1.001)} {parts} {' '.join(rows)} {low} {high}"
        " d = VMIN(d, low + fz * (high - low)); }"
    )
