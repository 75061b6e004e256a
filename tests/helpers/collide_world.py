# SPDX-License-Identifier: Apache-2.0
"""Collision functions of the engine `fused` in a separate kernel, and MuJoCo C's contacts of the same poses."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import warp as wp

import warpmpc.physics
from warpmpc.physics.meshes import Hulls
from warpmpc.physics.runtime import bake
from warpmpc.physics.version import RULES

NATIVE = Path(warpmpc.physics.__file__).parent / "native"
EXTRA = ""
"""More compiler flags, to try them."""
MOST = 12
"""Contacts a pair may have here."""
ROW = 11
"""Floats of a contact: distance, position, normal, first tangent, 1."""

_WORLD = """
#if defined(__CUDA_ARCH__)
#define FN __device__ static
#define INLINE __device__ __forceinline__ static
#define LOOK __device__
#else
#define FN __attribute__((noinline)) static
#define INLINE __attribute__((always_inline)) static inline
#define LOOK
#endif
#define splat(x) ((T)(x))
#define YES SET
#define NO ((I)0)
#define VNOT(m) FLIP(m)
static const float pair_margin[2] = {0.0f, MARGIN};
TABLES
struct Collide {
struct V3 {
    T x, y, z;
    LOOK V3 operator+(V3 b) const { V3 r = {x + b.x, y + b.y, z + b.z}; return r; }
    LOOK V3 operator-(V3 b) const { V3 r = {x - b.x, y - b.y, z - b.z}; return r; }
    LOOK V3 operator*(T s) const { V3 r = {x * s, y * s, z * s}; return r; }
};
INLINE T dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE V3 cross(V3 a, V3 b) { V3 r = {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; return r; }
INLINE V3 load(const T* p) { V3 r = {p[0], p[1], p[2]}; return r; }
struct World {
    T gpos[2][3], gmat[2][9], size[2][3];
    I count;
    int blocks;
    T out[MOST][ROW];
};
INLINE T gsize(World& w, int g, int k) { return w.size[g][k]; }
INLINE V3 tangent(V3 n) {
    const I up = VABS(n.y) >= 0.5f;
    const T ty = up ? splat(0.0f) : splat(1.0f), tz = up ? splat(1.0f) : splat(0.0f);
    const T d = n.y * ty + n.z * tz;
    const V3 t = {-n.x * d, ty - n.y * d, tz - n.z * d};
    return t * (1.0f / VSQRT(dot(t, t)));
}
FN void put(World& w, int pair, I m, T dist, V3 p, V3 n, V3 t) {
    const T row[ROW] = {dist, p.x, p.y, p.z, n.x, n.y, n.z, t.x, t.y, t.z, splat(1.0f)};
#if SPEED
    T* o = w.out[w.blocks++ % MOST];
    for (int k = 0; k < ROW; ++k) o[k] = m ? row[k] : o[k];
#else
    for (int s = 0; s < MOST; ++s) {
        const I here = m & (w.count == (I)s);
        for (int k = 0; k < ROW; ++k) w.out[s][k] = here ? row[k] : w.out[s][k];
    }
    w.count = m ? w.count + (I)1 : w.count;
    w.blocks += 1;
#endif
}
SOURCE
FN void call(World& w, int kind, int pair) {
    switch (kind) {
CASES
    }
}
FN void run(int group, int kind, int pair, int repeat, const float* pose, float* out, int* blocks) {
    World w;
    for (int k = 0; k < 30; ++k) {
        const T x = VLOAD(pose + (group * 30 + k) * LANES);
        const int g = k / 15, i = k % 15;
        if (i < 3) w.gpos[g][i] = x; else if (i < 12) w.gmat[g][i - 3] = x; else w.size[g][i - 12] = x;
    }
    w.count = (I)0;
    w.blocks = 0;
    for (int s = 0; s < MOST; ++s)
        for (int k = 0; k < ROW; ++k) w.out[s][k] = splat(0.0f);
    for (int k = 0; k < repeat; ++k) call(w, kind, pair);
    for (int s = 0; s < MOST; ++s)
        for (int k = 0; k < ROW; ++k) VSTORE(out + ((group * MOST + s) * ROW + k) * LANES, w.out[s][k]);
    blocks[group] = w.blocks;
}
};
Collide::run(group, kind, pair, repeat, pose.data, out.data, blocks.data);
#undef MESHES
#undef RING
#undef FN
#undef LOOK
#undef INLINE
#undef splat
#undef YES
#undef NO
#undef VNOT
"""


MARGIN = 0.02
"""Margin of pair 1; that of pair 0 is 0."""


def make_kernel(files, calls, *, lanes: int, speed: bool = False, tables: str = "") -> wp.Kernel:
    """A kernel whose threads each collide a group of pairs with one of some functions.

    Args:
        files: Headers with the functions.
        calls: Their names; the kernel's `kind` counts them.
        lanes: Pairs in a group; 1: the number type is a float, as on a GPU.
        speed: `put` keeps what it gets anywhere, which costs little.
        tables: Constants before the functions.
    """
    on_cpu = re.sub(r"\b(f\w+f|sqrtf|rintf)\b\(", r"__builtin_\1(", bake._ONE)
    one = f"#if defined(__CUDA_ARCH__)\n{bake._ONE}#else\n{on_cpu}#endif\n#define LANES 1\n"
    head = "\n".join(f"#undef {name}" for name in bake.NAMES) + "\n" + one if lanes == 1 else bake.header(lanes)
    cases = "\n".join(f"    case {k}: {name}(w, pair, 0, 1, YES); break;" for k, name in enumerate(calls))
    text = head + _WORLD.replace("SOURCE", "\n".join((NATIVE / f).read_text() for f in ("collide_common.h", *files)))
    # the cases hold words of the others
    words = {
        "CASES": cases,
        "SET": "1" if lanes == 1 else "((I)(-1))",
        "FLIP(m)": "(!(m))" if lanes == 1 else "(~(m))",
        "MARGIN": f"{MARGIN}f",
    }
    words |= {"TABLES": tables, "MOST": str(MOST), "ROW": str(ROW), "SPEED": str(int(speed))}
    words |= {rule: str(value) for rule, value in RULES.items()}
    for word, value in words.items():
        text = re.sub(rf"\b{re.escape(word)}" + (r"\b" if word[-1] != ")" else ""), value, text)
    if lanes > 1:
        text = re.sub(r"\bLANES\b", str(lanes), text)
    else:
        text += "#undef LANES\n"

    @wp.func_native(text)
    def collide(
        group: int,
        kind: int,
        pair: int,
        repeat: int,
        pose: wp.array[float],
        out: wp.array[float],
        blocks: wp.array[int],
    ): ...

    flags = (wp.config.cpu_compiler_flags or "") + (bake.WIDE if lanes == 16 else "") + EXTRA

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": flags})
    def kernel(
        # inputs
        kind: int,
        pair: int,
        repeat: int,
        pose: wp.array[float],  # [groups, 2 geoms x (position, matrix, size), lanes]
        # outputs
        out: wp.array[float],  # [groups, contacts, row, lanes]
        blocks: wp.array[int],  # [groups] times that `put` was called
    ):
        collide(wp.tid(), kind, pair, repeat, pose, out, blocks)

    return kernel


@dataclass
class Poses:
    """Pairs of geoms: position [N, 2, 3], matrix [N, 2, 9], size [N, 2, 3]."""

    pos: np.ndarray
    mat: np.ndarray
    size: np.ndarray

    def take(self, index) -> Poses:
        """Some of them."""
        return Poses(self.pos[index], self.mat[index], self.size[index])

    def lanes(self, lanes: int) -> wp.array:
        """As the kernel reads them, the last repeated to full groups."""
        x = np.concatenate([self.pos, self.mat, self.size], axis=2).reshape(len(self.pos), 30).astype(np.float32)
        x = np.concatenate([x, np.repeat(x[-1:], -len(x) % lanes, axis=0)])
        return wp.array(x.reshape(-1, lanes, 30).transpose(0, 2, 1).ravel(), dtype=float, device="cpu")


def ours(kernel: wp.Kernel, kind: int, poses: Poses, lanes: int, pair: int = 0) -> list[np.ndarray]:
    """Contacts [n, 10] of each pair."""
    pose = poses.lanes(lanes)
    groups = len(pose) // 30 // lanes
    out, blocks = (
        wp.zeros(groups * MOST * ROW * lanes, dtype=float, device="cpu"),
        wp.zeros(groups, dtype=int, device="cpu"),
    )
    wp.launch(kernel, dim=groups, inputs=[kind, pair, 1, pose], outputs=[out, blocks], device="cpu")
    rows = out.numpy().reshape(groups, MOST, ROW, lanes).transpose(0, 3, 1, 2).reshape(-1, MOST, ROW)[: len(poses.pos)]
    return [r[r[:, 10] > 0, :10] for r in rows]


def nanoseconds(
    kernel: wp.Kernel, kind: int, poses: Poses, lanes: int, repeat: int = 200, runs: int = 7
) -> tuple[float, float]:
    """Least time of a call for one group of lanes [ns], and mean number of times that it called `put`."""
    pose = poses.lanes(lanes)
    groups = len(pose) // 30 // lanes
    out, blocks = (
        wp.zeros(groups * MOST * ROW * lanes, dtype=float, device="cpu"),
        wp.zeros(groups, dtype=int, device="cpu"),
    )
    least = np.inf
    for _ in range(runs):
        start = time.perf_counter()
        wp.launch(kernel, dim=groups, inputs=[kind, 0, repeat, pose], outputs=[out, blocks], device="cpu")
        least = min(least, time.perf_counter() - start)
    return 1e9 * least / groups / repeat, float(blocks.numpy().mean() / repeat)


def model(kinds: tuple[str, str], margin: float = 0.0, asset: str = "", several: bool = False) -> mujoco.MjModel:
    """Two geoms that may collide; the first is fixed, both are moved by writing their poses.

    Args:
        kinds: Their types.
        margin: Of both together [m].
        asset: Elements with the mesh "mesh".
        several: Whether flat shapes have several contacts (multiccd).
    """
    sizes = {"plane": "1 1 1", "sphere": "1", "capsule": "1 1", "cylinder": "1 1", "box": "1 1 1", "ellipsoid": "1 1 1"}
    geoms = [f'type="{k}" size="{sizes[k]}"' if k in sizes else f'type="mesh" mesh="{k}"' for k in kinds]
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><option><flag multiccd="{"enable" if several else "disable"}"/></option><asset>{asset}</asset>
<default><geom margin="{margin / 2}"/></default><worldbody>
<geom {geoms[0]}/><body><freejoint/><geom {geoms[1]} mass="1"/></body></worldbody></mujoco>""")


def theirs(mj: mujoco.MjModel, poses: Poses) -> list[np.ndarray]:
    """MuJoCo C's contacts [n, 10] of each pair, from geom 1 to geom 2 in the order given."""
    data, found, bound = mujoco.MjData(mj), [], mj.geom_rbound.copy()
    for pos, mat, size in zip(poses.pos, poses.mat, poses.size, strict=True):
        mj.geom_size[:] = size
        mj.geom_rbound[:] = np.where(
            mj.geom_type == mujoco.mjtGeom.mjGEOM_MESH, bound, np.where(mj.geom_type == 0, 0.0, 100.0)
        )
        mj.geom_aabb[:, 3:] = 100.0
        data.geom_xpos[:], data.geom_xmat[:] = pos, mat
        mujoco.mj_collision(mj, data)
        c = data.contact
        rows = np.concatenate([c.dist[:, None], c.pos, c.frame[:, :6]], axis=1) if data.ncon else np.zeros((0, 10))
        found.append(rows[rows[:, 0] < mj.geom_margin.sum()] if data.ncon else rows)
    return found


def mesh_tables(mj: mujoco.MjModel) -> str:
    """The hulls of the meshes of both geoms, as the functions read them."""
    hulls = Hulls.of(mj, {0, 1})

    def table(kind: str, name: str, values) -> str:
        values = np.asarray(values).ravel()
        text = ", ".join(f"{float(x)!r}f" if kind == "float" else str(int(x)) for x in values)
        return f"static const {kind} {name}[{len(values)}] = {{{text}}};\n"

    floats = {"mesh_vertex": hulls.vertex, "mesh_face_normal": hulls.face_normal}
    ints = {"mesh_first": hulls.first, "mesh_count": hulls.count}
    ints |= {"mesh_face_vertex": hulls.face_vertex, "mesh_face_first": hulls.face_first}
    tables = [table("float", *row) for row in floats.items()] + [table("int", *row) for row in ints.items()]
    return "#undef MESHES\n#define MESHES 1\n" + "".join(tables)


@dataclass
class Agreement:
    """How two lists of contacts differ; the differences are of pairs with equal numbers of contacts."""

    pairs: int
    touching: int
    same: float  # share with the same number, of pairs where either has contacts
    dist: np.ndarray
    pos: np.ndarray
    normal: np.ndarray
    tangent: np.ndarray
    odd: np.ndarray  # pairs with other numbers
    kept: np.ndarray  # pairs that the differences are of

    def __str__(self) -> str:
        def three(x: np.ndarray) -> str:
            return "/".join(f"{v:.1e}" for v in (np.median(x), np.percentile(x, 99), x.max())) if len(x) else "-"

        return (
            f"{self.pairs} pairs, {self.touching} touch, same number {100 * self.same:.2f} %; median/p99/max of "
            f"distance {three(self.dist)}, position {three(self.pos)}, normal {three(self.normal)}, "
            f"tangent {three(self.tangent)}"
        )


def compare(a: list[np.ndarray], b: list[np.ndarray]) -> Agreement:
    """Contacts of each pair against each other, as sets: each with the nearest position of the other's."""
    touching, odd, kept, rows = 0, [], [], []
    for k, (x, y) in enumerate(zip(a, b, strict=True)):
        if not len(x) and not len(y):
            continue
        touching += 1
        if len(x) != len(y):
            odd.append(k)
            continue
        gap = np.linalg.norm(x[:, None, 1:4] - y[None, :, 1:4], axis=-1)
        to, back = gap.argmin(axis=1), gap.min(axis=0).max()
        kept.append(k)
        rows.append((
            np.abs(x[:, 0] - y[to, 0]).max(),
            max(gap.min(axis=1).max(), back),
            np.linalg.norm(x[:, 4:7] - y[to, 4:7], axis=1).max(),
            np.linalg.norm(x[:, 7:] - y[to, 7:], axis=1).max(),
        ))  # fmt: skip
    d = np.array(rows).reshape(-1, 4)
    return Agreement(len(a), touching, 1 - len(odd) / max(touching, 1), *d.T, np.array(odd, int), np.array(kept, int))
