// SPDX-License-Identifier: Apache-2.0
// Two convex shapes and their support functions.
//
// Everything is along the axes of geom 1 with its centre as origin. Capsules and spheres are a core and a radius.
// After collide_common.h. With MESHES defined as 1 also meshes, from constant tables of their convex hulls: mesh_vertex [3 a
// vertex], of geom g mesh_count[g] from mesh_first[g] on.

enum { PRISM = 1, SPHERE = 2, CAPSULE = 3, ELLIPSOID = 4, CYLINDER = 5, BOX = 6, MESH = 7 };  // MuJoCo's numbers, but for the prism

struct Shapes {
    int kind1, kind2, g1, g2;
    V3 s1, s2, p;  // sizes, centre of geom 2
    T r[9];        // axes of geom 2 as columns
    T round1, round2;
    V3 origin;     // of geom 1, in the world
#if FIELDS
    V3 corner[6];  // of a prism: three above, those below them
#endif
};

// farthest point of a shape without its radius in direction d, along its own axes
INLINE V3 farthest(int kind, int g, V3 s, V3 d) {
    const T zero = splat(0.0f);
    V3 f = {zero, zero, zero};
    if (kind == BOX) {
        const V3 b = {d.x < 0.0f ? -s.x : s.x, d.y < 0.0f ? -s.y : s.y, d.z < 0.0f ? -s.z : s.z};
        f = b;
    } else if (kind == CYLINDER) {
        const T k = s.x / VSQRT(VMAX(d.x * d.x + d.y * d.y, splat(1e-30f)));
        const V3 c = {d.x * k, d.y * k, d.z < 0.0f ? -s.y : s.y};
        f = c;
    } else if (kind == CAPSULE) {
        f.z = d.z < 0.0f ? -s.y : s.y;
    } else if (kind == ELLIPSOID) {
        const V3 q = {s.x * d.x, s.y * d.y, s.z * d.z};
        const T k = 1.0f / VSQRT(VMAX(dot(q, q), splat(1e-30f)));
        const V3 e = {s.x * q.x * k, s.y * q.y * k, s.z * q.z * k};
        f = e;
    }
#if MESHES
    else if (kind == MESH) {
        const float* v = mesh_vertex + 3 * mesh_first[g];
        T best = splat(-1e10f);
        for (int k = 0; k < mesh_count[g]; ++k, v += 3) {
            const T far = d.x * v[0] + d.y * v[1] + d.z * v[2];
            const I m = far > best;
            best = m ? far : best;
            f.x = m ? splat(v[0]) : f.x;
            f.y = m ? splat(v[1]) : f.y;
            f.z = m ? splat(v[2]) : f.z;
        }
    }
#endif
    return f;
}
// farthest point of M, without radii, in direction d, and the point of A in it
INLINE V3 corner_of(const Shapes& s, V3 d, V3& a) {
#if FIELDS
    if (s.kind1 == PRISM) {
        T best = splat(-1e10f);
        for (int k = 0; k < 6; ++k) {
            const T far = dot(s.corner[k], d);
            const I m = far > best;
            best = m ? far : best;
            a = choose(m, s.corner[k], a);
        }
    } else
#endif
    a = farthest(s.kind1, s.g1, s.s1, d);
    return a - s.p - in_world(s.r, farthest(s.kind2, s.g2, s.s2, along_axes(s.r, d * splat(-1.0f))));
}
INLINE V3 unit(V3 d) { return d * (1.0f / VSQRT(VMAX(dot(d, d), splat(1e-30f)))); }
