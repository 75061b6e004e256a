// SPDX-License-Identifier: Apache-2.0
// Box against box: the contacts of MuJoCo since 3.12, with masks instead of branches, one world per lane.
//
// The rule (MuJoCo's engine_collision_box.c, described there): of the 15 axes that can separate two boxes (three face
// normals of each, nine products of edges) the one with the largest separation wins. A face: the most opposed face of
// the other box, clipped by the sides of that face, gives up to eight contacts, each as deep as it lies below the
// face. A product of edges: one contact between the nearest points of the two edges. A face is preferred on constraints,
// and where the edges' axis is within 8 degrees of it and not better by 5 %. After collide_common.h.

// a, b or c for k = 0, 1, 2
INLINE T of_three(I k, T a, T b, T c) { return k == (I)0 ? a : k == (I)1 ? b : c; }

// component k, k + 1, k + 2 (mod 3) of v as x, y, z
INLINE V3 turned(I k, V3 v) {
    const V3 r = {of_three(k, v.x, v.y, v.z), of_three(k, v.y, v.z, v.x), of_three(k, v.z, v.x, v.y)};
    return r;
}
// up to eight points of a plane per lane, packed: lane l holds points 0 to count[l] - 1
struct Patch {
    T x[8], y[8];
    I count;
    int most;  // slots that any lane may use
};
INLINE void keep(Patch& c, I m, T x, T y) {
    if (!VANY(m)) return;
    if (c.most < 8) ++c.most;
    for (int s = 0; s < c.most; ++s) {
        const I here = m & (c.count == (I)s);
        c.x[s] = here ? x : c.x[s];
        c.y[s] = here ? y : c.y[s];
    }
    c.count = m ? c.count + (I)1 : c.count;
}

// where the line o + t d, |t| <= 1, is within |x| <= h: narrows lo and hi; inverse = 1 / |d|
INLINE void within(T o, T d, T inverse, T h, T& lo, T& hi) {
    const T s = d < 0.0f ? -o : o;
    lo = VMAX(lo, (-h - s) * inverse);
    hi = VMIN(hi, (h - s) * inverse);
}

// two opposite edges of the clipped parallelogram, c + e + t d and c - e + t d: where they start and where they are cut.
// One runs down t, the other up, so that each corner starts one of the four.
INLINE void clip_edges(Patch& patch, I m, T margin, V3 c, V3 d, V3 e, T hx, T hy) {
    const T ix = 1.0f / VMAX(VABS(d.x), splat(1e-12f)), iy = 1.0f / VMAX(VABS(d.y), splat(1e-12f));
#pragma unroll
    for (int side = 0; side < 2; ++side) {
        const V3 o = side ? c - e : c + e;
        T lo = splat(-1.0f), hi = splat(1.0f);
        within(o.x, d.x, ix, hx, lo, hi);
        within(o.y, d.y, iy, hy, lo, hi);
        const I on = m & (lo < hi);
        const T start = side ? lo : hi, end = side ? hi : lo;
        keep(patch, on & (o.z + start * d.z < margin), o.x + start * d.x, o.y + start * d.y);
        keep(patch, on & (o.z + end * d.z < margin) & (side ? end < 1.0f : end > -1.0f), o.x + end * d.x, o.y + end * d.y);
    }
}

FN void box_box(World& w, int pair, int g1, int g2, I near) {
    const float margin = pair_margin[pair];
    const T* r1 = w.gmat[g1];
    const T* r2 = w.gmat[g2];
    const V3 h1 = {gsize(w, g1, 0), gsize(w, g1, 1), gsize(w, g1, 2)}, h2 = {gsize(w, g2, 0), gsize(w, g2, 1), gsize(w, g2, 2)};
    const V3 d = load(w.gpos[g2]) - load(w.gpos[g1]);
    const T s1[3] = {h1.x, h1.y, h1.z}, s2[3] = {h2.x, h2.y, h2.z};
    const T scale = h1.x + h1.y + h1.z + h2.x + h2.y + h2.z;
    const T slack = margin + 1e-6f * scale;

    // r[i][j] = axis i of box 1 . axis j of box 2; p, q: from centre to centre along the axes of box 1, of box 2
    T r[3][3], a[3][3], p[3], q[3];
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        p[i] = r1[i] * d.x + r1[3 + i] * d.y + r1[6 + i] * d.z;
        q[i] = r2[i] * d.x + r2[3 + i] * d.y + r2[6 + i] * d.z;
    }
    I in = near, axis = (I)0;  // axis of the best face: 0 to 2 of box 1, 3 to 5 of box 2
    T face = splat(-1e10f);    // its separation
#pragma unroll
    for (int i = 0; i < 3; ++i) {
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            r[i][j] = r1[i] * r2[j] + r1[3 + i] * r2[3 + j] + r1[6 + i] * r2[6 + j];
            a[i][j] = VABS(r[i][j]);
        }
        const T apart = VABS(p[i]) - s1[i] - (a[i][0] * s2[0] + a[i][1] * s2[1] + a[i][2] * s2[2]);
        const I better = apart > face;
        face = better ? apart : face;
        axis = better ? (I)i : axis;
    }
    in = in & (face <= slack);
    if (!VANY(in)) return;
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        const T apart = VABS(q[j]) - s2[j] - (a[0][j] * s1[0] + a[1][j] * s1[1] + a[2][j] * s1[2]);
        const I better = apart > face;
        face = better ? apart : face;
        axis = better ? (I)(3 + j) : axis;
    }
    in = in & (face <= slack);
    if (!VANY(in)) return;

    // axis i of box 1 x axis j of box 2, not normalized: its length is the sine of their angle, and in box 2 it is row i of r
    // turned by 90 degrees. Signed squares are compared, so no root or quotient is needed: x |x| grows with x.
    // Separations of nearly parallel edges are noise: what rounding can make is taken off.
    const T biased = face + 1e-6f * VABS(face);
    T best = biased * VABS(biased), length = splat(1.0f);
    I edge = (I)0, ei = (I)0, ej = (I)0;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
            const T n2 = r[i1][j] * r[i1][j] + r[i2][j] * r[i2][j];
            const T radius = s1[i1] * a[i2][j] + s1[i2] * a[i1][j] + s2[j1] * a[i][j2] + s2[j2] * a[i][j1];
            const T apart = VABS(r[i1][j] * p[i2] - r[i2][j] * p[i1]) - radius - 3e-7f * scale;
            const T square = apart * VABS(apart);
            const I real = n2 > 1e-7f;
            in = in & VNOT(real & (square > slack * slack * n2));
            const I better = real & (square * length > best * n2);
            best = better ? square : best;
            length = better ? n2 : length;
            edge = better ? YES : edge;
            ei = better ? (I)i : ei;
            ej = better ? (I)j : ej;
        }
    }
    edge = edge & in;
    if (!VANY(in)) return;

    V3 edge_normal, edge_pos;
    T edge_dist;
    if (VANY(edge)) {
        // in the frame of box 1: along its edge i (d1), along edge j of box 2 (d2), from box 1 to box 2 (n, across)
        const V3 d1 = {ei == (I)0 ? splat(1.0f) : splat(0.0f), ei == (I)1 ? splat(1.0f) : splat(0.0f), ei == (I)2 ? splat(1.0f) : splat(0.0f)};
        const V3 d2 = {of_three(ej, r[0][0], r[0][1], r[0][2]), of_three(ej, r[1][0], r[1][1], r[1][2]), of_three(ej, r[2][0], r[2][1], r[2][2])};
        const V3 at = {p[0], p[1], p[2]}, product = cross(d1, d2);
        const V3 across = choose(dot(product, at) < 0.0f, product * splat(-1.0f), product);
        const T inv = 1.0f / VSQRT(VMAX(dot(across, across), splat(1e-7f)));
        const V3 n = across * inv;
        const V3 m = {r[0][0] * across.x + r[1][0] * across.y + r[2][0] * across.z,
                      r[0][1] * across.x + r[1][1] * across.y + r[2][1] * across.z,
                      r[0][2] * across.x + r[1][2] * across.y + r[2][2] * across.z};  // across along the axes of box 2
        // middles of the two edges: the corner of box 1 towards box 2 and the other way round, without the edge's own part
        const T zero = splat(0.0f);
        const V3 o = {ei == (I)0 ? zero : across.x < 0.0f ? -h1.x : h1.x, ei == (I)1 ? zero : across.y < 0.0f ? -h1.y : h1.y,
                      ei == (I)2 ? zero : across.z < 0.0f ? -h1.z : h1.z};
        const V3 c = {ej == (I)0 ? zero : m.x < 0.0f ? h2.x : -h2.x, ej == (I)1 ? zero : m.y < 0.0f ? h2.y : -h2.y,
                      ej == (I)2 ? zero : m.z < 0.0f ? h2.z : -h2.z};
        const V3 e = {at.x + r[0][0] * c.x + r[0][1] * c.y + r[0][2] * c.z - o.x, at.y + r[1][0] * c.x + r[1][1] * c.y + r[1][2] * c.z - o.y,
                      at.z + r[2][0] * c.x + r[2][1] * c.y + r[2][2] * c.z - o.z};
        edge_dist = dot(n, e);
        // the face instead, where its axis is nearly the same and not much worse
        const T along = VABS(axis < (I)3 ? of_three(axis, n.x, n.y, n.z) : of_three(axis - (I)3, m.x, m.y, m.z) * inv);
        edge = edge & VNOT((along > 0.99f) & (edge_dist < face + 0.05f * VABS(face)));
        // their nearest points: o + s d1, o + e + t d2
        const T k1 = dot(d1, h1), k2 = of_three(ej, h2.x, h2.y, h2.z), b = dot(d1, d2), de = dot(d2, e), ee = dot(d1, e);
        T s = (ee - b * de) * (inv * inv);  // |across|^2 = 1 - b^2
        s = VMIN(VMAX(s, -k1), k1);
        const T t = VMIN(VMAX(b * s - de, -k2), k2);
        s = VMIN(VMAX(ee + b * t, -k1), k1);
        edge_pos = in_world(r1, o + (e + d1 * s + d2 * t) * splat(0.5f)) + load(w.gpos[g1]);
        edge_normal = in_world(r1, n);
    }

    Patch patch;
    patch.count = (I)0;
    patch.most = 0;
    const I flat = in & VNOT(edge);
    V3 x, y, z, origin;  // frame of the face, z outwards
    T level, slope_x, slope_y;
    if (VANY(flat)) {
        // the face's box, axes of the other one in it; turned so that the face's normal is the third axis: (f + 1, f + 2, f)
        const I first = axis < (I)3;
        const I k = (first ? axis : axis - (I)3);
        const I k1 = k == (I)2 ? (I)0 : k + (I)1;
        V3 col[3];
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            const V3 v = {first ? r[0][j] : r[j][0], first ? r[1][j] : r[j][1], first ? r[2][j] : r[j][2]};
            col[j] = turned(k1, v);
        }
        const V3 at = turned(k1, V3{first ? p[0] : -q[0], first ? p[1] : -q[1], first ? p[2] : -q[2]});
        const V3 h = turned(k1, choose(first, h1, h2)), ho = choose(first, h2, h1);
        const I below = at.z < 0.0f;
        // its most opposed face: axis b, and the two axes u, v in that face
        const T z0 = VABS(col[0].z), z1 = VABS(col[1].z), z2 = VABS(col[2].z);
        const I b = ((z1 > z0) & (z1 >= z2)) ? (I)1 : ((z2 > z0) & (z2 > z1)) ? (I)2 : (I)0;
        const V3 hb = turned(b, ho);
        const V3 bx = turned(b, V3{col[0].x, col[1].x, col[2].x}), by = turned(b, V3{col[0].y, col[1].y, col[2].y}),
                 bz = turned(b, V3{col[0].z, col[1].z, col[2].z});
        const T up = (bz.x > 0.0f ? -hb.x : hb.x), towards = below ? -up : up;  // to the face of b that looks at the other box
        const T flip = below ? splat(-1.0f) : splat(1.0f);
        const V3 c = {at.x + towards * bx.x, at.y + towards * by.x, flip * (at.z + towards * bz.x) - h.z};
        const V3 u = {hb.y * bx.y, hb.y * by.y, flip * hb.y * bz.y}, v = {hb.z * bx.z, hb.z * by.z, flip * hb.z * bz.z};
        // a corner on the other's side counts as inside, whatever the rounding
        const V3 far = load(w.gpos[g2]);
        const T tol = 1e-6f * (h.x + h.y) + 2e-7f * (VABS(far.x) + VABS(far.y) + VABS(far.z));
        const T limit = splat(margin), hx = h.x + tol, hy = h.y + tol;
        clip_edges(patch, flat, limit, c, u, v, hx, hy);
        clip_edges(patch, flat, limit, c, v, u * splat(-1.0f), hx, hy);
        // corners of the face strictly inside the parallelogram, which is the plane z = level + slope . (x, y)
        const T inv = 1.0f / (u.x * v.y - u.y * v.x);
        slope_x = (u.z * v.y - u.y * v.z) * inv;
        slope_y = (u.x * v.z - u.z * v.x) * inv;
        level = c.z - slope_x * c.x - slope_y * c.y;
        const float inside = 1.0f - 2e-6f;
#pragma unroll
        for (int i = 0; i < 4; ++i) {
            const T cx = i & 1 ? h.x : -h.x, cy = i & 2 ? h.y : -h.y;
            const T ox = cx - c.x, oy = cy - c.y;
            const T s = (ox * v.y - oy * v.x) * inv, t = (oy * u.x - ox * u.y) * inv;
            keep(patch, flat & (VABS(s) < inside) & (VABS(t) < inside) & (level + slope_x * cx + slope_y * cy < limit), cx, cy);
        }
        // the frame in the world
        V3 row[3];
#pragma unroll
        for (int i = 0; i < 3; ++i) row[i] = turned(k1, V3{first ? r1[3 * i] : r2[3 * i], first ? r1[3 * i + 1] : r2[3 * i + 1], first ? r1[3 * i + 2] : r2[3 * i + 2]});
        x = V3{row[0].x, row[1].x, row[2].x};
        y = V3{row[0].y, row[1].y, row[2].y};
        z = V3{row[0].z, row[1].z, row[2].z} * flip;
        origin = choose(first, load(w.gpos[g1]), load(w.gpos[g2])) + z * h.z;
        // from box 1 to box 2
        const T sign = first ? splat(1.0f) : splat(-1.0f);
        edge_normal = choose(edge, edge_normal, z * sign);
    }
    const V3 n = edge_normal, t = tangent(n);
    const I touch = edge & (edge_dist < margin);
    if (patch.most == 0 && VANY(touch)) patch.most = 1;
    for (int s = 0; s < patch.most; ++s) {
        I m = patch.count > (I)s;
        T dist = level + slope_x * patch.x[s] + slope_y * patch.y[s];
        V3 c = origin + x * patch.x[s] + y * patch.y[s] + z * (0.5f * dist);
        if (s == 0) {
            c = choose(edge, edge_pos, c);
            dist = edge ? edge_dist : dist;
            m = m | touch;
        }
        if (VANY(m)) put(w, pair, m, dist, c, n, t);
    }
}
