// SPDX-License-Identifier: Apache-2.0
// Any two convex shapes by their support functions: one contact, as MuJoCo's native collision makes it without multiccd;
// with it (RING is not 0) flat shapes have more (manifold.h).
//
// What is asked for: the direction n, from geom 1 to geom 2, with the least h(n) = max over a in A, b in B of n . (a - b); the
// contact's distance is -h(n). With M = A - B that is the nearest point of the boundary of M, from inside when the shapes
// overlap (where MuJoCo expands a polytope), from outside when they don't (GJK). Both the same way here, masks instead
// of branches: from a direction n take the point y = d n outside of M, project it on M by GJK (Gilbert, Johnson, Keerthi 1988), and
// its normal there is the next n. With d = 0 that is the answer. Otherwise errors shrink by d / (d + R - h) a time, R
// the radius of curvature of M: at once on faces and edges, by about depth / R on round shapes. The best of
// the shapes' own axes and a few more directions is where it starts; every n is judged by its exact h(n), so a distance is never
// larger than the truth's, but deep in round shapes it may be a local one.
//
// After shapes.h, and after manifold.h where RING is not 0.
// For planes and meshes also tables of what each vertex v of a hull has around it, a row for each face (MuJoCo's mesh_poly*), from mesh_face_first[v] to before mesh_face_first[v + 1]: mesh_face_normal [3 a row], and
// mesh_face_vertex [3 a row], the other vertices of the largest quadrangle in that face with v, counted from mesh_first[g], or -1.

// h of a direction of the lanes in m; keeps the better
FN void try_direction(const Shapes& s, I m, V3 d, V3& n, T& h) {
    const V3 u = unit(d);
    V3 a;
    const T f = dot(corner_of(s, u, a), u);
    const I better = m & (dot(d, d) > 1e-12f) & (f < h);
    n = choose(better, u, n);
    h = better ? f : h;
}
// the same with the sign that leads to the centre of geom 2
INLINE void try_axis(const Shapes& s, V3 d, V3& n, T& h) {
    try_direction(s, dot(d, d) > 1e-6f, choose(dot(d, s.p) < 0.0f, d * splat(-1.0f), d), n, h);
}

// three points of M - y, whose triangle holds the nearest one to the origin (found so far); what of A is in them
struct Simplex {
    V3 w[3], a[3];
    T l[3];  // weights in the nearest point
};

// the nearest point v of M - y to the origin, for the lanes in m. It must not be inside.
FN void nearest_of(const Shapes& s, V3 y, I m, Simplex& x, V3& v) {
    const T zero = splat(0.0f), one = splat(1.0f);
    T best = dot(v, v);
    for (int k = 0; k < 24; ++k) {
        V3 a;
        const V3 w = corner_of(s, v * splat(-1.0f), a) - y;
        // the plane through w bounds M - y: how much nearer than v anything can be
        m = m & (best - dot(v, w) > 3e-6f * best);
        if (!VANY(m)) return;
        // of w with one and with two of the others: weights of the nearest
        T near = dot(w, w), l1 = zero, l2 = zero;
        I first = (I)0;  // the other two are x[first + 1], x[first + 2]
        V3 e[3];
        T ee[3], we[3];
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            e[i] = x.w[i] - w;
            ee[i] = dot(e[i], e[i]);
            we[i] = -dot(w, e[i]);
            const T t = VMIN(VMAX(we[i] / VMAX(ee[i], splat(1e-20f)), zero), one);
            const V3 p = w + e[i] * t;
            const T d = dot(p, p);
            const I better = d < near;
            near = better ? d : near;
            first = better ? (I)((i + 2) % 3) : first;
            l1 = better ? t : l1;
        }
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            const int j = (i + 1) % 3, o = (i + 2) % 3;
            const T ij = dot(e[i], e[j]), det = ee[i] * ee[j] - ij * ij, inv = 1.0f / VMAX(det, splat(1e-30f));
            const T t = (ee[j] * we[i] - ij * we[j]) * inv, u = (ee[i] * we[j] - ij * we[i]) * inv;
            const V3 p = w + e[i] * t + e[j] * u;
            const T d = dot(p, p);
            const I better = (det > 1e-6f * ee[i] * ee[j]) & (t > 0.0f) & (u > 0.0f) & (t + u < 1.0f) & (d < near);
            near = better ? d : near;
            first = better ? (I)o : first;
            l1 = better ? t : l1;
            l2 = better ? u : l2;
        }
        // rounding: no nearer than before
        m = m & (near < best);
        if (!VANY(m)) return;
        const I f0 = first == (I)0, f1 = first == (I)1;
        const V3 w1 = choose(f0, x.w[1], choose(f1, x.w[2], x.w[0])), w2 = choose(f0, x.w[2], choose(f1, x.w[0], x.w[1]));
        const V3 a1 = choose(f0, x.a[1], choose(f1, x.a[2], x.a[0])), a2 = choose(f0, x.a[2], choose(f1, x.a[0], x.a[1]));
        const T l0 = one - l1 - l2;
        const V3 p = w * l0 + w1 * l1 + w2 * l2;
        x.w[0] = choose(m, w, x.w[0]);
        x.w[1] = choose(m, choose(l1 > 0.0f, w1, w), x.w[1]);
        x.w[2] = choose(m, choose(l2 > 0.0f, w2, w), x.w[2]);
        x.a[0] = choose(m, a, x.a[0]);
        x.a[1] = choose(m, choose(l1 > 0.0f, a1, a), x.a[1]);
        x.a[2] = choose(m, choose(l2 > 0.0f, a2, a), x.a[2]);
        x.l[0] = m ? l0 : x.l[0];
        x.l[1] = m ? l1 : x.l[1];
        x.l[2] = m ? l2 : x.l[2];
        v = choose(m, p, v);
        best = m ? dot(p, p) : best;
    }
}

#if RING
INLINE bool flat(int kind) { return kind == CAPSULE || kind > ELLIPSOID; }
#endif
INLINE void shapes_of(World& w, int g1, int g2, int kind1, int kind2, Shapes& s) {
    const T zero = splat(0.0f);
    s.kind1 = kind1;
    s.kind2 = kind2;
    s.g1 = g1;
    s.g2 = g2;
    s.s1 = V3{gsize(w, g1, 0), gsize(w, g1, 1), gsize(w, g1, 2)};
    s.s2 = V3{gsize(w, g2, 0), gsize(w, g2, 1), gsize(w, g2, 2)};
    s.round1 = kind1 == SPHERE || kind1 == CAPSULE ? s.s1.x : zero;
    s.round2 = kind2 == SPHERE || kind2 == CAPSULE ? s.s2.x : zero;
    s.origin = load(w.gpos[g1]);
    s.p = along_axes(w.gmat[g1], load(w.gpos[g2]) - s.origin);
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const V3 c = along_axes(w.gmat[g1], axis_of(w, g2, k));
        s.r[k] = c.x;
        s.r[3 + k] = c.y;
        s.r[6 + k] = c.z;
    }
}
FN void meet(World& w, int pair, const Shapes& s, I near) {
    const T zero = splat(0.0f), one = splat(1.0f), margin = splat(pair_margin[pair]);
    const T* r1 = w.gmat[s.g1];
    const int kind1 = s.kind1, kind2 = s.kind2;
    const V3 c[3] = {{s.r[0], s.r[3], s.r[6]}, {s.r[1], s.r[4], s.r[7]}, {s.r[2], s.r[5], s.r[8]}};
    const T round = s.round1 + s.round2;

    // a first direction: between the centres, then axes of both, products of axes, across the main axis of each
    const V3 x = {one, zero, zero}, y = {zero, one, zero}, z = {zero, zero, one};
    V3 n = z, a;
    T h = splat(1e10f);
    try_axis(s, s.p, n, h);
    I on = near & (-h - round < margin);
    if (!VANY(on)) return;
    if (kind1 != SPHERE) try_axis(s, z, n, h);
    try_axis(s, c[2], n, h);
    try_axis(s, V3{s.p.x, s.p.y, zero}, n, h);
    try_axis(s, s.p - c[2] * dot(s.p, c[2]), n, h);
    try_axis(s, cross(z, c[2]), n, h);
#if FIELDS
    if (kind1 == PRISM) {
        try_axis(s, cross(s.corner[1] - s.corner[0], s.corner[2] - s.corner[0]) * splat(1e3f), n, h);
        try_axis(s, V3{s.corner[0].y - s.corner[1].y, s.corner[1].x - s.corner[0].x, zero} * splat(1e3f), n, h);
        for (int k = 0; k < 3; ++k) {
            const V3 edge = unit(s.corner[k == 2 ? 0 : k + 1] - s.corner[k]);
            try_axis(s, cross(edge, c[2]), n, h);
            if (kind2 == BOX) {
                try_axis(s, cross(edge, c[0]), n, h);
                try_axis(s, cross(edge, c[1]), n, h);
            }
        }
    }
#endif
    if (kind1 == BOX || kind1 == ELLIPSOID || kind1 == PRISM) {
        try_axis(s, x, n, h);
        try_axis(s, y, n, h);
        try_axis(s, cross(x, c[2]), n, h);
        try_axis(s, cross(y, c[2]), n, h);
    }
    if (kind2 == BOX || kind2 == ELLIPSOID) {
        try_axis(s, c[0], n, h);
        try_axis(s, c[1], n, h);
        try_axis(s, cross(z, c[0]), n, h);
        try_axis(s, cross(z, c[1]), n, h);
    }
#if MESHES
    if (VANY(near & (-h - round < zero))) {  // within each other: faces of a mesh often look along its own axes
        if (kind1 == MESH) try_axis(s, x, n, h), try_axis(s, y, n, h);
        if (kind2 == MESH) try_axis(s, c[0], n, h), try_axis(s, c[1], n, h);
    }
#endif
    on = on & (-h - round < margin);
    if (!VANY(on)) return;

    // the gap to keep: large enough for exact normals, small for fast convergence
    const T gap = 0.05f * VMIN(s.s1.x, s.s2.x), tiny = 1e-6f * (VABS(s.p.x) + VABS(s.p.y) + VABS(s.p.z) + gap);
    Simplex q;
    V3 at = n * VMAX(zero, h + gap);
    const V3 start = corner_of(s, n, a);
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        q.w[k] = start - at;
        q.a[k] = a;
        q.l[k] = k ? zero : one;
    }
    V3 v = q.w[0], on_a = a, on_m = start;
    I todo = on;
    for (int k = 0; k < 4; ++k) {
        nearest_of(s, at, todo, q, v);
        const V3 pa = q.a[0] * q.l[0] + q.a[1] * q.l[1] + q.a[2] * q.l[2];
        on_a = choose(todo, pa, on_a);
        on_m = choose(todo, v + at, on_m);
        // the next direction, that of the triangle (exact on faces), and further on the way: errors shrink slowly on round shapes
        const V3 before = n, next = unit(v * splat(-1.0f)), step = next - n;
        const T h0 = h;
        const V3 flat = cross(q.w[1] - q.w[0], q.w[2] - q.w[0]);
        try_direction(s, todo, next, n, h);
        try_direction(s, todo, flat * (dot(flat, next) < 0.0f ? splat(-1e6f) : splat(1e6f)), n, h);
        todo = todo & (dot(step, step) > 1e-9f) & (dot(at, at) > 0.0f);
        if (VANY(todo)) {
            for (int far = 2; far < 40; far *= 2) try_direction(s, todo, before + step * splat((float)far), n, h);
        }
        // from the origin itself that was the answer
        todo = todo & (h0 - h > tiny) & (-h - round < margin);
        if (!VANY(todo)) break;
        const V3 to = n * VMAX(zero, h + gap);
        const V3 shift = choose(todo, at - to, V3{zero, zero, zero});
        at = at - shift;
#pragma unroll
        for (int i = 0; i < 3; ++i) q.w[i] = q.w[i] + shift;
        v = v + shift;
        // nearest of the shifted triangle: start again from its nearest corner
        T least = splat(1e10f);
        V3 cw = q.w[0], ca = q.a[0];
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            const T l2 = dot(q.w[i], q.w[i]);
            const I nearer = l2 < least;
            least = nearer ? l2 : least;
            cw = choose(nearer, q.w[i], cw);
            ca = choose(nearer, q.a[i], ca);
        }
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            q.w[i] = choose(todo, cw, q.w[i]);
            q.a[i] = choose(todo, ca, q.a[i]);
            q.l[i] = todo ? (i ? zero : one) : q.l[i];
        }
        v = choose(todo, cw, v);
    }
    const T dist = -h - round;
    I touch = on & (dist < margin);
    if (!VANY(touch)) return;
#if RING
    if (flat(kind1) && flat(kind2)) {
        touch = touch & VNOT(manifold(w, pair, s, touch, n));
        if (!VANY(touch)) return;
    }
#endif
    const V3 mid = on_a - on_m * splat(0.5f) + n * (0.5f * (s.round1 - s.round2)), normal = in_world(r1, n);
    put(w, pair, touch, dist, in_world(r1, mid) + s.origin, normal, tangent(normal));
}
FN void convex(World& w, int pair, int g1, int g2, int kind1, int kind2, I near) {
    Shapes s;
    shapes_of(w, g1, g2, kind1, kind2, s);
    if (!CENTRES_MEET) near = near & (dot(s.p, s.p) > 1e-12f);  // MuJoCo 3 finds nothing where the centres are one
    meet(w, pair, s, near);
}

FN void sphere_ellipsoid(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, SPHERE, ELLIPSOID, near); }
FN void capsule_ellipsoid(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, CAPSULE, ELLIPSOID, near); }
FN void capsule_cylinder(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, CAPSULE, CYLINDER, near); }
FN void ellipsoid_ellipsoid(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, ELLIPSOID, ELLIPSOID, near); }
FN void ellipsoid_cylinder(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, ELLIPSOID, CYLINDER, near); }
FN void ellipsoid_box(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, ELLIPSOID, BOX, near); }
FN void cylinder_cylinder(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, CYLINDER, CYLINDER, near); }
FN void cylinder_box(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, CYLINDER, BOX, near); }

#if MESHES
FN void sphere_mesh(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, SPHERE, MESH, near); }
FN void capsule_mesh(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, CAPSULE, MESH, near); }
FN void ellipsoid_mesh(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, ELLIPSOID, MESH, near); }
FN void cylinder_mesh(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, CYLINDER, MESH, near); }
FN void box_mesh(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, BOX, MESH, near); }
FN void mesh_mesh(World& w, int pair, int g1, int g2, I near) { convex(w, pair, g1, g2, MESH, MESH, near); }

// the deepest vertex, and those of its face that looks most at the plane, up to four (MuJoCo 3.17's rule, which mujoco_warp's
// plane_convex shows; 3.12 took neighbours in the hull): those below the mesh's centre and the margin
FN void plane_mesh(World& w, int pair, int g1, int g2, I near) {
    const V3 n = axis_of(w, g1, 2), p = load(w.gpos[g2]), down = along_axes(w.gmat[g2], n * splat(-1.0f)), t = tangent(n);
    const T c = dot(p - load(w.gpos[g1]), n), margin = splat(pair_margin[pair]);
    const float* v = mesh_vertex + 3 * mesh_first[g2];
    const int* faces = mesh_face_first + mesh_first[g2];
    T best = splat(-1e10f);
    I which = (I)0;
    V3 spot[4] = {down, down, down, down};
    for (int k = 0; k < mesh_count[g2]; ++k) {
        const V3 x = {splat(v[3 * k]), splat(v[3 * k + 1]), splat(v[3 * k + 2])};
        const T far = dot(down, x);
        const I m = far > best;
        best = m ? far : best;
        which = m ? (I)k : which;
        spot[0] = choose(m, x, spot[0]);
    }
    const I on = near & (c - best < margin);
    if (!VANY(on)) return;
    // lanes with the same deepest vertex together
    I count = (I)1;
    for (int k = 0; k < mesh_count[g2]; ++k) {
        const I here = on & (which == (I)k);
        if (!VANY(here)) continue;
        T most = splat(-1.0f);
        for (int f = faces[k]; f < faces[k + 1]; ++f) {
            const float* fn = mesh_face_normal + 3 * f;
            const T facing = down.x * fn[0] + down.y * fn[1] + down.z * fn[2];
            const I m = here & (facing > most);
            most = m ? facing : most;
            for (int i = 0; i < 3; ++i) {
                const int u = mesh_face_vertex[3 * f + i];
                if (u < 0) break;
                const V3 x = {splat(v[3 * u]), splat(v[3 * u + 1]), splat(v[3 * u + 2])};
                spot[i + 1] = choose(m, x, spot[i + 1]);
                count = m ? (I)(i + 2) : count;
            }
        }
    }
    for (int k = 0; k < 4; ++k) {
        const V3 x = in_world(w.gmat[g2], spot[k]);
        const T low = dot(x, n), dist = c + low;
        const I m = on & (count > (I)k) & (low <= 0.0f) & (dist < margin);
        if (VANY(m)) put(w, pair, m, dist, p + x - n * (0.5f * dist), n, t);
    }
}
#endif
