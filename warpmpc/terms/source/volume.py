# SPDX-License-Identifier: Apache-2.0
"""Source of lookups in distance volumes: one gather for a point, or eight; beside ``kernels.geometry.volume``.

The numbers of the volume that is looked at are ``vol``.
"""

from __future__ import annotations

from dataclasses import dataclass

from ...bake.lines import literal


@dataclass(frozen=True)
class Grid:
    """Placement of the voxels of a volume."""

    origin: tuple[float, float, float]
    """Lowest corner [m]."""
    inverse: float
    """Voxels per metre."""
    size: tuple[int, int, int]
    """Voxels along x, y, z."""


def place(point: list[str], grid: Grid, shift: float, top: float) -> str:
    """Place of a point among the voxels: ``x``, ``y``, ``z``, and their whole parts ``ix``, ``iy``, ``iz``."""
    out = []
    for axis, at, origin, size in zip("xyz", point, grid.origin, grid.size, strict=True):
        cells = f"({at} - {literal(origin)}) * {literal(grid.inverse)}" + (f" - {literal(shift)}" if shift else "")
        out.append(
            f"const T {axis} = VMIN(VMAX({cells}, 0.0f), {literal(size - top)}); const I i{axis} = VINT({axis});"
        )
    return f"{' '.join(out)} const I at = (iz * {grid.size[1]} + iy) * {grid.size[0]} + ix;"


def nearest(point: list[str], grid: Grid) -> str:
    """``volume.voxel_distance``: the least of it and ``d`` into ``d``."""
    return f"{{ {place(point, grid, 0.0, 0.001)} d = VMIN(d, VGATHER(vol, at)); }}"


def between(point: list[str], grid: Grid) -> str:
    """``volume.between_voxels``: the least of it and ``d`` into ``d``."""
    return f"{{ {eight(point, grid)} d = VMIN(d, value); }}"


def eight(point: list[str], grid: Grid) -> str:
    """``volume.eight_voxels`` as ``value``, at ``x``, ``y``, ``z`` counted between the centres of the voxels."""
    nx, ny, _ = grid.size
    rows = []
    for name, offset in (("a", 0), ("b", nx), ("c", nx * ny), ("d", nx * (ny + 1))):
        first = f"const T {name}0 = VGATHER(vol, at + {offset});"
        rows.append(f"{first} const T {name}1 = {name}0 + fx * (VGATHER(vol, at + {offset + 1}) - {name}0);")
    parts = " ".join(f"const T f{axis} = {axis} - VFLOAT(i{axis});" for axis in "xyz")
    low, high = "const T low = a1 + fy * (b1 - a1);", "const T high = c1 + fy * (d1 - c1);"
    value = "const T value = low + fz * (high - low);"
    return f"{place(point, grid, 0.5, 1.001)} {parts} {' '.join(rows)} {low} {high} {value}"


def with_bound(point: list[str], grid: Grid) -> str:
    """``mesh_volume.mesh_distance``: the least of it and ``inside`` into ``inside``."""
    half, voxel, away = literal(0.5), literal(1.0 / grid.inverse), []
    for axis, at, origin in zip("xyz", point, grid.origin, strict=True):
        cells = f"({at} - {literal(origin)}) * {literal(grid.inverse)} - {half}"
        away.append(f"const T o{axis} = {voxel} * ({cells} - {axis});")
    beyond = "const T beyond = ox * ox + oy * oy + oz * oz;"
    found = "VSELECT(beyond > 0.0f, VSQRT(value * value + beyond), value)"
    return f"{{ {eight(point, grid)} {' '.join(away)} {beyond} inside = VMIN(inside, {found}); }}"
