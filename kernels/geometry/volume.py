# SPDX-License-Identifier: Apache-2.0
"""Distance volumes of point clouds: exact distances between voxels, by one sweep along each axis.

Felzenszwalb and Huttenlocher 2012 take distances apart by axes; with a reach of few voxels the lower envelope is found
by looking at all of them, which vectorizes. On a CPU a thread takes a row of voxels along x, on a GPU one voxel of it.

Signed distance volumes of closed convex meshes, computed once.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

ABREAST = 16
"""Voxels along x that a CPU takes at once; rows are a multiple of it."""

LONGEST = 1280
"""Voxels along x with the reach on both sides, at most."""

_WIDE = f"""
typedef unsigned short S __attribute__((ext_vector_type({ABREAST})));
typedef unsigned char B __attribute__((ext_vector_type({ABREAST})));
typedef float F __attribute__((ext_vector_type({ABREAST})));
struct __attribute__((packed, aligned(1))) BU {{ B v; }};
struct __attribute__((packed, aligned(2))) SU {{ S v; }};
struct __attribute__((packed, aligned(4))) FU {{ F v; }};
"""
"""Types of that many numbers in a register, and of them anywhere in memory."""


def _native(source: str) -> str:
    """A snippet with the types of :data:`_WIDE`."""
    return source.replace("WIDE;", _WIDE).replace("ABREAST", str(ABREAST)).replace("LONGEST", str(LONGEST))


@wp.struct
class Volume:
    """Distance of voxels from the nearest occupied one, up to a reach, as cost terms read it."""

    distance: wp.array[float]  # [E · nz · ny · nx] between the voxels' centres [m]
    origin: wp.vec3  # lowest corner [m]
    inverse: float  # voxels per metre
    nx: int
    ny: int
    nz: int


@wp.struct
class VolumeWork:
    """Inputs and memory that a volume is built from and in."""

    points: wp.array2d[wp.vec3]  # [E, capacity] [m]
    count: wp.array[int]  # [E] how many of them there are
    version: wp.array[int]  # [E] of the points
    built: wp.array[int]  # [E] version that the volume shows
    occupied: wp.array[wp.uint8]  # [E · nz · ny · nx] all zero between two builds
    along_z: wp.array[wp.uint16]  # [E · nz · ny · nx] squared distance along z [voxels²]
    in_plane: wp.array[wp.uint16]  # [E · nz · ny · nx] squared, in the plane of y and z [voxels²]; on a GPU alone
    reach: int  # [voxels]
    voxel: float  # [m]
    eye: wp.vec3  # where the points are seen from [m]
    behind: float  # how far behind a point is taken for filled [m]
    volume: Volume


@wp.kernel
def scatter_kernel(
    # inputs
    work: VolumeWork,
    threads: int,  # of an environment
    # outputs
    occupied: wp.array[wp.uint8],
):
    """One thread: mark the voxels of some points; those outside and those that are not finite mark none."""
    i = wp.tid()
    e = i // threads
    if work.built[e] != work.version[e]:
        mark_points(work, e, i % threads, threads)


@wp.func_native("""
const float* __restrict__ p = (const float*)work.points.data + (size_t)3 * e * work.points.shape[1];
unsigned char* __restrict__ o = (unsigned char*)work.occupied.data;
const int nx = work.volume.nx, ny = work.volume.ny, nz = work.volume.nz, count = work.count.data[e];
o += (size_t)e * nz * ny * nx;
const float inverse = work.volume.inverse, wide = nx, deep = ny, high = nz;
const float ox = work.volume.origin[0], oy = work.volume.origin[1], oz = work.volume.origin[2];
const int further = (int)ceilf(work.behind * inverse);
int last = -1; // pixels of a row that share a voxel share what is behind it
for (int i = first; i < count; i += stride) {
    float x = (p[3 * i] - ox) * inverse, y = (p[3 * i + 1] - oy) * inverse, z = (p[3 * i + 2] - oz) * inverse;
    // false for NaN, too
    const bool inside = x >= 0.0f && y >= 0.0f && z >= 0.0f && x < wide && y < deep && z < high;
    const int at = inside ? ((int)z * ny + (int)y) * nx + (int)x : -1;
    if (inside) o[at] = 1;
    if (further == 0 || (inside && at == last)) continue;
    last = at;
    float dx = p[3 * i] - work.eye[0], dy = p[3 * i + 1] - work.eye[1], dz = p[3 * i + 2] - work.eye[2];
    const float scale = 1.0f / sqrtf(dx * dx + dy * dy + dz * dz);
    dx *= scale; dy *= scale; dz *= scale;
    if (inside) { // as many steps as stay in the region, without a look at its sides: 16 bits are parts of a voxel
        const float ax = (dx > 0.0f ? wide - x : x) / (fabsf(dx) + 1.0e-9f);
        const float ay = (dy > 0.0f ? deep - y : y) / (fabsf(dy) + 1.0e-9f);
        const float az = (dz > 0.0f ? high - z : z) / (fabsf(dz) + 1.0e-9f);
        const float least = (ax < ay ? (ax < az ? ax : az) : (ay < az ? ay : az)) - 0.01f;
        const int steps = least < further ? (int)least : further;
        int px = (int)(x * 65536.0f), py = (int)(y * 65536.0f), pz = (int)(z * 65536.0f);
        const int sx = (int)(dx * 65536.0f), sy = (int)(dy * 65536.0f), sz = (int)(dz * 65536.0f);
        for (int k = 0; k < steps; ++k) {
            px += sx; py += sy; pz += sz;
            o[((pz >> 16) * ny + (py >> 16)) * nx + (px >> 16)] = 1;
        }
        continue;
    }
    for (int k = 0; k < further; ++k) {
        x += dx; y += dy; z += dz;
        if (x >= 0.0f && y >= 0.0f && z >= 0.0f && x < wide && y < deep && z < high)
            o[((int)z * ny + (int)y) * nx + (int)x] = 1;
    }
}
""")
def mark_points(work: VolumeWork, e: int, first: int, stride: int):
    """Mark the voxels of every ``stride``-th point, and those that lie behind it as seen from the eye.

    Of points that follow one another in one voxel, as those of a picture do, only the first is looked behind.
    """
    ...


@wp.kernel
def sweep_z_kernel(
    # inputs
    work: VolumeWork,
    columns: int,  # threads of a row: 1 on the CPU, nx on a GPU
    # outputs
    along_z: wp.array[wp.uint16],
):
    """One thread: distances along z to the nearest marked voxel, for one y; the marks are wiped out."""
    i = wp.tid()
    row = i // columns
    e = row // work.volume.ny
    if work.built[e] != work.version[e]:
        sweep_z(work, e, row % work.volume.ny, i % columns)


@wp.func_native(
    _native("""
const int nx = work.volume.nx, nz = work.volume.nz, plane = nx * work.volume.ny;
const size_t start = (size_t)e * nz * plane + y * nx;
unsigned char* __restrict__ o = (unsigned char*)work.occupied.data + start;
unsigned short* __restrict__ g = (unsigned short*)work.along_z.data + start;
const unsigned short far = work.reach + 1;
#if defined(__CUDA_ARCH__)
int d = far;
for (int z = 0; z < nz; ++z) {
    d = o[z * plane + x] ? 0 : min(d + 1, (int)far);
    o[z * plane + x] = 0;
    g[z * plane + x] = d;
}
d = far;
for (int z = nz - 1; z >= 0; --z) { d = min(d + 1, (int)g[z * plane + x]); g[z * plane + x] = d * d; }
#else
WIDE;
for (int i = 0; i < nx; i += ABREAST) {
    S d = (S)far;
    for (int z = 0; z < nz; ++z) {
        BU* mark = (BU*)(o + z * plane + i);
        const S free = __builtin_convertvector(mark->v, S) - (S)1; // all bits set where there is no mark
        d = __builtin_elementwise_min(d + (S)1, (S)far) & free;
        mark->v = (B)0;
        ((SU*)(g + z * plane + i))->v = d;
    }
    d = (S)far;
    for (int z = nz - 1; z >= 0; --z) {
        SU* here = (SU*)(g + z * plane + i);
        d = __builtin_elementwise_min(d + (S)1, here->v);
        here->v = d * d;
    }
}
#endif
""")
)
def sweep_z(work: VolumeWork, e: int, y: int, x: int):
    """Upwards and downwards along z; x counts on a GPU alone."""
    ...


@wp.kernel
def sweep_row_kernel(
    # inputs
    work: VolumeWork,
    # outputs
    distance: wp.array[float],
):
    """One thread of a CPU: distances of one row along x, first in the plane of y and z, then in space."""
    row = wp.tid()
    e = row // (work.volume.ny * work.volume.nz)
    if work.built[e] != work.version[e]:
        sweep_row(work, row)


@wp.func_native(
    _native("""
#if !defined(__CUDA_ARCH__)
WIDE;
const int nx = work.volume.nx, ny = work.volume.ny, reach = work.reach, y = row % ny;
const unsigned short* __restrict__ g = (const unsigned short*)work.along_z.data + (size_t)(row - y) * nx;
float* __restrict__ out = (float*)work.volume.distance.data + (size_t)row * nx;
const int from = y > reach ? y - reach : 0, to = y + reach < ny - 1 ? y + reach : ny - 1;
const unsigned short far = (reach + 1) * (reach + 1);
unsigned short f[LONGEST]; // of the row, with caps at both ends
for (int i = 0; i < reach; ++i) f[i] = f[reach + nx + i] = far;
for (int i = 0; i < nx; i += ABREAST) {
    S best = (S)far;
    S square = (S)(unsigned short)((from - y) * (from - y)), step = (S)(unsigned short)(2 * (from - y) + 1);
    for (int k = from; k <= to; ++k) {
        best = __builtin_elementwise_min(best, ((const SU*)(g + k * nx + i))->v + square);
        square += step; // (k + 1)² = k² + 2k + 1, modulo 2¹⁶
        step += (S)2;
    }
    ((SU*)(f + reach + i))->v = best;
}
for (int i = 0; i < nx; i += ABREAST) {
    S best = (S)far;
    S square = (S)(unsigned short)(reach * reach), step = (S)(unsigned short)(1 - 2 * reach);
    for (int k = 0; k <= 2 * reach; ++k) {
        best = __builtin_elementwise_min(best, ((const SU*)(f + i + k))->v + square);
        square += step;
        step += (S)2;
    }
    ((FU*)(out + i))->v = __builtin_elementwise_sqrt(__builtin_convertvector(best, F)) * work.voxel;
}
#endif
""")
)
def sweep_row(work: VolumeWork, row: int):
    """The least over the rows beside this one, then over the voxels beside each one, and its root."""
    ...


@wp.kernel
def sweep_y_kernel(
    # inputs
    work: VolumeWork,
    # outputs
    in_plane: wp.array[wp.uint16],
):
    """One thread of a GPU: squared distance of one voxel in the plane of y and z."""
    i = wp.tid()
    nx, ny = work.volume.nx, work.volume.ny
    row = i // nx
    e = row // (ny * work.volume.nz)
    if work.built[e] == work.version[e]:
        return
    y = row % ny
    best = (work.reach + 1) * (work.reach + 1)
    for k in range(wp.max(y - work.reach, 0), wp.min(y + work.reach + 1, ny)):
        best = wp.min(best, int(work.along_z[i + (k - y) * nx]) + (k - y) * (k - y))
    in_plane[i] = wp.uint16(best)


@wp.kernel
def sweep_x_kernel(
    # inputs
    work: VolumeWork,
    # outputs
    distance: wp.array[float],
):
    """One thread of a GPU: distance of one voxel in space."""
    i = wp.tid()
    nx = work.volume.nx
    e = i // (nx * work.volume.ny * work.volume.nz)
    if work.built[e] == work.version[e]:
        return
    x = i % nx
    best = (work.reach + 1) * (work.reach + 1)
    for k in range(wp.max(x - work.reach, 0), wp.min(x + work.reach + 1, nx)):
        best = wp.min(best, int(work.in_plane[i + k - x]) + (k - x) * (k - x))
    distance[i] = wp.sqrt(float(best)) * work.voxel


@wp.kernel
def built_kernel(
    # inputs
    version: wp.array[int],  # [E]
    # outputs
    built: wp.array[int],  # [E]
):
    """One thread: the volume of one environment shows its points."""
    e = wp.tid()
    built[e] = version[e]


@wp.func
def voxel_distance(volume: Volume, e: int, at: wp.vec3) -> float:
    """Distance of the voxel that a point is in [m]; of the nearest one for points outside."""
    p = (at - volume.origin) * volume.inverse
    x = int(wp.clamp(p[0], 0.0, float(volume.nx) - 0.001))
    y = int(wp.clamp(p[1], 0.0, float(volume.ny) - 0.001))
    z = int(wp.clamp(p[2], 0.0, float(volume.nz) - 0.001))
    return volume.distance[((e * volume.nz + z) * volume.ny + y) * volume.nx + x]


@wp.func
def row_distance(distance: wp.array[float], at: int, part: float) -> float:
    """Distance between a voxel and the next along x [m]."""
    here = distance[at]
    return here + part * (distance[at + 1] - here)


@wp.func
def eight_voxels(distance: wp.array[float], first: int, nx: int, ny: int, at: wp.vec3) -> float:
    """Distance linear between the centres of eight voxels [m].

    Args:
        distance: Of the voxels' centres [m].
        first: Where the volume begins.
        nx: Voxels along x.
        ny: Voxels along y.
        at: Place in voxels, whole numbers at their centres, one before the last at most.
    """
    x, y, z = int(at[0]), int(at[1]), int(at[2])
    fx, fy, fz = at[0] - float(x), at[1] - float(y), at[2] - float(z)
    start = first + (z * ny + y) * nx + x
    above = start + nx * ny
    low = row_distance(distance, start, fx)
    low += fy * (row_distance(distance, start + nx, fx) - low)
    high = row_distance(distance, above, fx)
    high += fy * (row_distance(distance, above + nx, fx) - high)
    return low + fz * (high - low)


@wp.func
def inside_volume(p: wp.vec3, nx: int, ny: int, nz: int) -> wp.vec3:
    """The place in voxels, as :func:`eight_voxels` takes it, that is nearest to one counted from the lowest corner."""
    return wp.vec3(
        wp.clamp(p[0] - 0.5, 0.0, float(nx - 1) - 0.001),
        wp.clamp(p[1] - 0.5, 0.0, float(ny - 1) - 0.001),
        wp.clamp(p[2] - 0.5, 0.0, float(nz - 1) - 0.001),
    )


@wp.func
def between_voxels(volume: Volume, e: int, at: wp.vec3) -> float:
    """Distance at a point, linear between the centres of eight voxels [m]."""
    g = inside_volume((at - volume.origin) * volume.inverse, volume.nx, volume.ny, volume.nz)
    return eight_voxels(volume.distance, e * volume.nz * volume.ny * volume.nx, volume.nx, volume.ny, g)


@wp.struct
class MeshVolumes:
    """Signed distances around meshes, one volume after the other, each in its mesh's own frame."""

    distance: wp.array[float]  # of the voxels' centres, x fastest [m]
    first: wp.array[int]  # [meshes] where a volume begins
    origin: wp.array[wp.vec3]  # [meshes] lowest corner [m]
    voxel: wp.array[float]  # [meshes] [m]
    size: wp.array[wp.vec3i]  # [meshes] voxels along x, y, z
    reach: float  # from a mesh to the sides of its volume at least, besides one voxel [m]


@wp.kernel
def mesh_distance_kernel(
    # inputs
    mesh: wp.uint64,
    origin: wp.vec3,
    voxel: float,
    size: wp.vec3i,
    farthest: float,
    first: int,
    # outputs
    distance: wp.array[float],
):
    """One thread: signed distance of the centre of one voxel from a mesh, negative inside."""
    i = wp.tid()
    x = i % size[0]
    y = (i // size[0]) % size[1]
    z = i // (size[0] * size[1])
    at = origin + voxel * wp.vec3(float(x) + 0.5, float(y) + 0.5, float(z) + 0.5)
    found = wp.mesh_query_point_sign_normal(mesh, at, farthest)
    nearest = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    distance[first + i] = found.sign * wp.length(at - nearest)


@wp.func
def mesh_distance(p: MeshVolumes, k: int, at: wp.vec3) -> float:
    """Signed distance of a point in a mesh's frame [m]; outside its volume a bound below it.

    The volume is convex and has the mesh in it: a point x outside and the point c of the volume nearest to it have
    (x - c)·(m - c) ≤ 0 for all m of the mesh, so that d(x)² ≥ ‖x - c‖² + d(c)².
    """
    size = p.size[k]
    cells = (at - p.origin[k]) / p.voxel[k]
    g = inside_volume(cells, size[0], size[1], size[2])
    d = eight_voxels(p.distance, p.first[k], size[0], size[1], g)
    away = p.voxel[k] * (cells - wp.vec3(0.5, 0.5, 0.5) - g)
    beyond = wp.dot(away, away)
    if beyond > 0.0:
        return wp.sqrt(d * d + beyond)
    return d
