# SPDX-License-Identifier: Apache-2.0
"""Source of the collision terms: spheres of links against each other and against shapes.

A group of spheres, those of one link, is looked at only where the sphere around it is near for any of the samples of a
number. Spheres of equal radius share one square root: the least squared distance comes first.

Source of lookups in distance volumes: one gather for a point, or eight; beside ``kernels.geometry.volume``.

The numbers of the volume that is looked at are ``vol``.

Source of ``cloud_collision``: one gather for a sphere, or eight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...kernels.cost.points import BOX, CAPSULE, CYLINDER, MESH, PLANE, SPHERE
from ...kernels.cost.view import TASK_BODY
from ...physics.runtime.bake import Operand, Vector, literal, text

if TYPE_CHECKING:
    from .state import TermCode


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
    """``volume.mesh_distance``: the least of it and ``inside`` into ``inside``."""
    half, voxel, away = literal(0.5), literal(1.0 / grid.inverse), []
    for axis, at, origin in zip("xyz", point, grid.origin, strict=True):
        cells = f"({at} - {literal(origin)}) * {literal(grid.inverse)} - {half}"
        away.append(f"const T o{axis} = {voxel} * ({cells} - {axis});")
    beyond = "const T beyond = ox * ox + oy * oy + oz * oz;"
    found = "VSELECT(beyond > 0.0f, VSQRT(value * value + beyond), value)"
    return f"{{ {eight(point, grid)} {' '.join(away)} {beyond} inside = VMIN(inside, {found}); }}"


_FAR = "((T)1.0e12f)"


@dataclass(frozen=True)
class GroupCode:
    """The spheres of one link, in the world's frame."""

    bound: list[str]
    """Centre of the sphere around them."""
    radius: float
    """Of the sphere around them [m]."""
    classes: dict[float, list[list[str]]]
    """Centres by radius [m]."""

    @property
    def count(self) -> int:
        """Number of spheres."""
        return sum(map(len, self.classes.values()))


def groups_of(code: TermCode, table: Any) -> list[GroupCode]:
    """The groups of a sphere table; terms about the same spheres share their centres."""
    centre, radius = table.centre.numpy(), table.radius.numpy()
    columns = (getattr(table, name).numpy() for name in ("body", "first", "count", "bound_centre", "bound_radius"))
    out = []
    for body, first, count, bound_centre, bound_radius in zip(*columns, strict=True):
        classes: dict[float, list[list[str]]] = {}
        for i in range(first, first + count):
            classes.setdefault(float(radius[i]), []).append(_named(code.state.body_point(int(body), centre[i])))
        bound = _named(code.state.body_point(int(body), bound_centre))
        out.append(GroupCode(bound, float(bound_radius), classes))
    return out


def _named(point: Vector) -> list[str]:
    return [text(x) for x in point]


def _squared(a: list[str], b: list[str]) -> str:
    return " + ".join(f"({x} - {y}) * ({x} - {y})" for x, y in zip(a, b, strict=True))


def self_collision(code: TermCode, p: Any) -> Operand:
    """``collision.self_collision``: max(0, margin + deepest penetration)."""
    groups, add = groups_of(code, p.spheres), code.lines.add
    deepest, margin = code.lines.let(f"(T)(-{code.params}.margin)"), f"{code.params}.margin"
    deepest = code.variable("deepest", deepest)
    for first, second in zip(p.first.numpy(), p.second.numpy(), strict=True):
        a, b = groups[first], groups[second]
        reach = f"({literal(a.radius + b.radius)} + {margin})"
        add(f"if (VANY({_squared(a.bound, b.bound)} < {reach} * {reach})) {{")
        pairs: dict[float, list[str]] = {}
        for (ra, own), (rb, others) in ((x, y) for x in a.classes.items() for y in b.classes.items()):
            pairs.setdefault(round(ra + rb, 9), []).extend(_squared(i, j) for i in own for j in others)
        for total, squared in pairs.items():
            add(f"{{ T d = {_FAR};")
            code.lines.statements.extend(f"d = VMIN(d, {expression});" for expression in squared)
            add(f"{deepest} = VMAX({deepest}, {literal(total)} - VSQRT(d)); }}")
        add("}")
    return code.lines.let(f"{deepest} + {margin}")


def world_collision(code: TermCode, p: Any) -> Operand | None:
    """``collision.world_collision``."""
    kinds = p.kind.numpy()
    poses = [_pose(code, int(body)) for body in p.body.numpy()]
    if None in poses:
        return None
    shapes = _shapes(code, poses)
    groups, margin = groups_of(code, p.spheres), f"{code.params}.margin"
    least, look = code.variable("least", f"(T){margin}"), _on_way_past if p.swept else _against
    for group in groups:
        for kind in np.unique(kinds):
            which = np.flatnonzero(kinds == kind)
            # a volume's numbers are written out: each mesh has source of its own
            for own in which[:, None] if kind == MESH else [which]:
                look(code, group, _Kind.of(code, p, int(kind), int(own[0])), own, shapes, least)
    if p.binary:
        return code.lines.let(f"VSELECT({least} < {margin}, 1.0f, 0.0f)")
    return code.lines.let(f"{margin} - {least}")


def _pose(code: TermCode, body: int) -> str | None:
    """Address of the seven numbers of a body's pose, None for those that joints move."""
    if body <= int(TASK_BODY):
        return f"(const float*)s.pose.data + 7 * (e * s.pose.shape[1] + {int(TASK_BODY) - body})"
    if body < 0:
        return "identity"
    start = code.state.free_start(body)
    return None if start is None else f"q_start + {start}"


def _shapes(code: TermCode, poses: list[str]) -> str:
    """Write the poses of obstacles down before the first step: rotation by rows, position; returns their name."""
    name, once = f"shapes_{code.params.replace('.', '_')}", code.state.once
    once.add(f"float {name}[{12 * max(len(poses), 1)}];")
    once.add(f"{{ const float identity[7] = {{0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 1.0f}};\n{_PLACE}")
    for k, pose in enumerate(poses):
        once.add(f"place({pose}, (const float*){code.params}.pose.data + {7 * k}, {name} + {12 * k});")
    once.add("}")
    return name


_PLACE = """auto place = [](const float* a, const float* b, float* out) {
const float ax = a[3], ay = a[4], az = a[5], aw = a[6], bx = b[3], by = b[4], bz = b[5], bw = b[6];
const float x = aw * bx + ax * bw + ay * bz - az * by, y = aw * by - ax * bz + ay * bw + az * bx;
const float z = aw * bz + ax * by - ay * bx + az * bw, w = aw * bw - ax * bx - ay * by - az * bz;
const float tx = 2.0f * (ay * b[2] - az * b[1]), ty = 2.0f * (az * b[0] - ax * b[2]);
const float tz = 2.0f * (ax * b[1] - ay * b[0]);
out[0] = 1.0f - 2.0f * (y * y + z * z); out[1] = 2.0f * (x * y - z * w); out[2] = 2.0f * (x * z + y * w);
out[3] = 2.0f * (x * y + z * w); out[4] = 1.0f - 2.0f * (x * x + z * z); out[5] = 2.0f * (y * z - x * w);
out[6] = 2.0f * (x * z - y * w); out[7] = 2.0f * (y * z + x * w); out[8] = 1.0f - 2.0f * (x * x + y * y);
out[9] = a[0] + b[0] + aw * tx + ay * tz - az * ty;
out[10] = a[1] + b[1] + aw * ty + az * tx - ax * tz;
out[11] = a[2] + b[2] + aw * tz + ax * ty - ay * tx;
};"""
"""Pose a · b, each (x, y, z, qx, qy, qz, qw), as nine numbers of a rotation by rows and three of a position."""


def _local(point: list[str]) -> str:
    """A point in the frame of the shape ``ob``: x, y, z."""
    away = ", ".join(f"d{axis} = {x} - ob[{9 + i}]" for i, (axis, x) in enumerate(zip("xyz", point, strict=True)))
    turned = " ".join(f"{axis} = ob[{i}] * dx + ob[{3 + i}] * dy + ob[{6 + i}] * dz;" for i, axis in enumerate("xyz"))
    return f"{{ const T {away}; {turned} }}"


_FACES = "x = VABS(x) - size[0]; y = VABS(y) - size[1]; z = VABS(z) - size[2];"
_SQUARE = {
    int(BOX): f"{_FACES} inside = VMIN(inside, VMAX(x, VMAX(y, z)));"
    " x = VMAX(x, 0.0f); y = VMAX(y, 0.0f); z = VMAX(z, 0.0f); d = VMIN(d, x * x + y * y + z * z);",
    int(CYLINDER): "x = VSQRT(x * x + y * y) - size[0]; z = VABS(z) - size[1]; inside = VMIN(inside, VMAX(x, z));"
    " x = VMAX(x, 0.0f); z = VMAX(z, 0.0f); d = VMIN(d, x * x + z * z);",
    int(SPHERE): "d = VMIN(d, x * x + y * y + z * z);",
    int(CAPSULE): "z = z - VMIN(VMAX(z, -size[1]), size[1]); d = VMIN(d, x * x + y * y + z * z);",
    int(PLANE): "inside = VMIN(inside, z);",
}
"""From a point in a shape's frame to the least squared distance ``d`` outside it and the least depth ``inside``."""
_SIZE = {int(SPHERE): " + size[0]", int(CAPSULE): " + size[0]"}
"""Difference of the root of ``d`` and the distance."""
_DISTANCE = {
    int(MESH): "inside",
    int(BOX): "VSELECT(inside < 0.0f, inside, VSQRT(d))",
    int(CYLINDER): "VSELECT(inside < 0.0f, inside, VSQRT(d))",
    int(SPHERE): "VSQRT(d) - size[0]",
    int(CAPSULE): "VSQRT(d) - size[0]",
    int(PLANE): "inside",
}


@dataclass(frozen=True)
class _Kind:
    """Distances to shapes of one kind."""

    square: str
    """From ``x``, ``y``, ``z`` to ``d`` and ``inside``, as in :data:`_SQUARE`."""
    distance: str
    """The distance from these."""
    near: str
    """Condition that it is less than ``near``."""
    size: str = ""
    """Difference of the root of ``d`` and the distance."""
    begin: str = ""
    """Statements before the first of them."""
    bound: str = ""
    """The same as :attr:`square`, or what is less and takes less time."""

    @staticmethod
    def of(code: TermCode, p: Any, kind: int, k: int) -> _Kind:
        """A kind, and of meshes one obstacle."""
        distance, near = _DISTANCE[kind], "inside < near" if kind in (PLANE, MESH) else "d < near * near"
        if kind != MESH:
            return _Kind(_SQUARE[kind], distance, near, _SIZE.get(kind, ""), bound=_SQUARE[kind])
        volumes, m = p.volumes, int(p.mesh.numpy()[k])
        origin, voxel, size = (getattr(volumes, name).numpy()[m] for name in ("origin", "voxel", "size"))
        grid = Grid(tuple(map(float, origin)), 1.0 / float(voxel), tuple(map(int, size)))
        begin = f"const float* vol = (const float*){code.params}.volumes.distance.data + {volumes.first.numpy()[m]};"
        copies = "const T px = x, py = y, pz = z;"
        square = f"{{ {copies} {with_bound(['px', 'py', 'pz'], grid)} }}"
        # the box around the mesh, or one that is larger by a voxel
        low = origin + voxel + volumes.reach
        half = 0.5 * (origin + size * voxel - voxel - volumes.reach - low)
        return _Kind(square, distance, near, begin=begin, bound=_outside_box(low + half, half))


def _outside_box(centre: np.ndarray, half: np.ndarray) -> str:
    """From ``x``, ``y``, ``z`` to the distance outside a box, into ``inside``."""
    axes = zip("xyz", centre, half, strict=True)
    faces = " ".join(
        f"const T o{axis} = VMAX(VABS({axis} - {literal(c)}) - {literal(h)}, 0.0f);" for axis, c, h in axes
    )
    return f"{{ {faces} inside = VMIN(inside, VSQRT(ox * ox + oy * oy + oz * oz)); }}"


def _each_shape(code: TermCode, kind: _Kind, which: np.ndarray, shapes: str) -> None:
    """Begin a loop over shapes: pose ``ob`` and ``size`` of one."""
    numbers = ", ".join(map(str, which))
    code.lines.add(f"{{ const int own[{len(which)}] = {{{numbers}}};")
    code.lines.add(f"for (int n = 0; n < {len(which)}; ++n) {{ const float* ob = {shapes} + 12 * own[n];")
    code.lines.add(f"const float* size = (const float*){code.params}.size.data + 3 * own[n]; T x, y, z; {kind.begin}")


def _against(code: TermCode, group: GroupCode, kind: _Kind, which: np.ndarray, shapes: str, least: str) -> None:
    """Least distance of a group's spheres from the shapes of one kind."""
    add = code.lines.add
    _each_shape(code, kind, which, shapes)
    if group.count > 1:
        add(f"{{ T d = {_FAR}, inside = {_FAR}; {_local(group.bound)} {kind.bound}")
        add(f"const float near = {literal(group.radius)} + {code.params}.margin{kind.size};")
        add(f"if (!VANY({kind.near})) continue; }}")
    for radius, centres in group.classes.items():
        add(f"{{ T d = {_FAR}, inside = {_FAR};")
        code.lines.statements.extend(f"{_local(centre)} {kind.square}" for centre in centres)
        add(f"{least} = VMIN({least}, {kind.distance} - {literal(radius)}); }}")
    add("} }")


def _on_way_past(code: TermCode, group: GroupCode, kind: _Kind, which: np.ndarray, shapes: str, least: str) -> None:
    """Least distance of a group's spheres from the shapes of one kind, on their straight ways from the step before.

    A distance changes no faster than the sphere moves: it moves on by as much as its distance is above the least so
    far, by a quarter of its radius at least, and is done when the rest of the way is too short to bring it nearer.
    """
    add, before = code.lines.add, code.state.before
    _each_shape(code, kind, which, shapes)
    there = [text(before(x)) for x in group.bound]
    middle = [f"(0.5f * ({x} + {y}))" for x, y in zip(group.bound, there, strict=True)]
    add(f"{{ T d = {_FAR}, inside = {_FAR}; {_local(middle)} {kind.bound}")
    add(f"const T reach = {literal(group.radius)} + 0.5f * VSQRT({_squared(group.bound, there)});")
    add(f"if (!VANY({kind.distance} < reach + {code.params}.margin)) continue; }}")
    for radius, centres in group.classes.items():
        for centre in centres:
            start = [text(before(x)) for x in centre]
            add(f"{{ T way = (T)0.0f; const T whole = VSQRT({_squared(start, centre)});")
            add("const T per = 1.0f / VMAX(whole, 1.0e-9f);")
            at = [f"({x} + way * per * ({y} - {x}))" for x, y in zip(centre, start, strict=True)]
            add(f"do {{ T d = {_FAR}, inside = {_FAR}; {_local(at)} {kind.square}")
            add(f"const T apart = {kind.distance} - {literal(radius)}, above = apart - {least};")
            add(f"{least} = VSELECT(way <= whole, VMIN({least}, apart), {least});")
            add(f"const T next = VMIN(way + VMAX(above, {literal(0.25 * radius)}), whole);")
            add("way = VSELECT(way < whole, VSELECT(above < whole - way, next, whole + 1.0f), whole + 1.0f);")
            add("} while (VANY(way <= whole)); }")
    add("} }")


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
        add(f"T d = {_CLOUD_FAR}; {nearest(group.bound, grid)}")
        add(f"if (VANY(d < {literal(reach)} + {margin} + {allowance})) {{")
    for radius, centres in group.classes.items():
        add(f"{{ T d = {_CLOUD_FAR};")
        code.lines.statements.extend(look(centre, grid) for centre in centres)
        add(f"{least} = VMIN({least}, d - {literal(radius)} - {allowance}); }}")
    add("} }" if group.count > 1 else "}")


_CLOUD_FAR = "((T)1.0e6f)"
