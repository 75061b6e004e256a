// SPDX-License-Identifier: Apache-2.0
// Several contacts between flat shapes that meet in one: the face that looks most at the other shape and what the other one
// has against it (a face, the line of a capsule or of a cylinder's mantle), clipped by the face's sides. Up to four of the
// points below the face remain, each as deep as it lies. Measured with MuJoCo 3.17 (flag multiccd), whose manual tells
// this for boxes and meshes; rims of cylinders are 16 points there, too. After shapes.h.
//
// Meshes have tables of their faces: those of geom g are ring_count[g] from ring_first[g] on; of face f ring_normal [3],
// ring_size corners and ring_corner [RING, 3], the last one repeated.

// A number of a table for every lane
INLINE T pick(const float* table, I at) {
#if defined(__CUDA_ARCH__)
    return table[at];
#else
    T out;
    for (int l = 0; l < LANES; ++l) ((float*)&out)[l] = table[((const int*)&at)[l]];
    return out;
#endif
}
struct Ring {      // corners around a face, or the ends of a line
    V3 at[RING];   // the last one repeated
    V3 normal;
    I count;       // 2: a line; 0: neither
};
// What a shape without its radius has in direction d, along its own axes
FN void feature(int kind, int g, V3 s, V3 d, Ring& f) {
    const T zero = splat(0.0f), one = splat(1.0f);
    f.count = (I)0;
    f.normal = V3{zero, zero, zero};
    if (kind == BOX) {
        const T x = VABS(d.x), y = VABS(d.y), z = VABS(d.z);
        const I kx = (x >= y) & (x >= z), ky = VNOT(kx) & (y >= z), kz = VNOT(kx | ky);
        const T side = (kx ? d.x : ky ? d.y : d.z) < 0.0f ? -one : one;
        f.normal = V3{kx ? side : zero, ky ? side : zero, kz ? side : zero};
        const V3 c = {f.normal.x * s.x, f.normal.y * s.y, f.normal.z * s.z};
        const V3 u = {kz ? s.x : zero, kx ? s.y : zero, ky ? s.z : zero};
        const V3 v = {ky ? side * s.x : zero, kz ? side * s.y : zero, kx ? side * s.z : zero};
        f.at[0] = c + u + v;
        f.at[1] = c - u + v;
        f.at[2] = c - u - v;
        for (int k = 3; k < RING; ++k) f.at[k] = c + u - v;
        f.count = (I)4;
    } else if (kind == CYLINDER || kind == CAPSULE) {
        const T level = VABS(d.z), side = d.z < 0.0f ? -one : one;
        const I line = level < 0.0888f;
#if RING >= 16
        const I cap = kind == CYLINDER ? level > 0.996f : NO;
#else
        const I cap = NO;
#endif
        const T out = kind == CYLINDER ? s.x / VSQRT(VMAX(d.x * d.x + d.y * d.y, splat(1e-30f))) : zero;
        for (int k = 0; k < RING; ++k) {
            const V3 end = {d.x * out, d.y * out, k ? s.y : -s.y};
#if RING >= 16
            const V3 rim = {s.x * ring_rim[k < 16 ? 2 * k : 30], side * s.x * ring_rim[k < 16 ? 2 * k + 1 : 31], side * s.y};
            f.at[k] = choose(cap, rim, end);
#else
            f.at[k] = end;
#endif
        }
        f.normal.z = cap ? side : zero;
        f.count = cap ? (I)16 : line ? (I)2 : (I)0;
    }
#if MESHES
    else if (kind == MESH) {
        T best = splat(-1e10f);
        I which = (I)0;
        for (int k = ring_first[g]; k < ring_first[g] + ring_count[g]; ++k) {
            const float* n = ring_normal + 3 * k;
            const T facing = d.x * n[0] + d.y * n[1] + d.z * n[2];
            const I m = facing > best;
            best = m ? facing : best;
            which = m ? (I)k : which;
            f.normal = choose(m, V3{splat(n[0]), splat(n[1]), splat(n[2])}, f.normal);
            f.count = m ? (I)ring_size[k] : f.count;
        }
        for (int k = 0; k < RING; ++k) {
            const I from = 3 * (RING * which + k);
            f.at[k] = V3{pick(ring_corner, from), pick(ring_corner, from + 1), pick(ring_corner, from + 2)};
        }
    }
#endif
}
INLINE void place(const Shapes& s, Ring& f) {  // from the axes of geom 2 to those of geom 1
    for (int k = 0; k < RING; ++k) f.at[k] = in_world(s.r, f.at[k]) + s.p;
    f.normal = in_world(s.r, f.normal);
}
INLINE T apart(const Shapes& s, V3 d) {
    V3 a;
    return -dot(corner_of(s, d, a), d) - s.round1 - s.round2;
}
// Points over a face: along two axes in it, height, and whether they are there
struct Points {
    T x[3 * RING], y[3 * RING], z[3 * RING];
    I on[3 * RING];
    int count;
};
INLINE void keep_point(Points& p, I m, T x, T y, T z) {
    if (!VANY(m)) return;
    p.x[p.count] = x;
    p.y[p.count] = y;
    p.z[p.count] = z;
    p.on[p.count] = m;
    ++p.count;
}
// Corners and crossings of a ring or line that are over a face, and corners of the face over the ring
INLINE void clip_ring(const T* fx, const T* fy, const T* x, const T* y, const T* z, I count, I m, T slack, T margin, Points& p) {
    const T zero = splat(0.0f), one = splat(1.0f);
    p.count = 0;
    T nx[RING], ny[RING], ox[RING], oy[RING], level[RING], bound[RING];  // inwards of sides: n . (x, y) - level >= 0
    T turn = zero;  // twice the area of the ring
    for (int k = 0; k < RING; ++k) {
        const int j = k + 1 < RING ? k + 1 : 0;
        const T ex = fx[j] - fx[k], ey = fy[j] - fy[k], l2 = ex * ex + ey * ey;
        const T inv = l2 > 1e-16f ? 1.0f / VSQRT(VMAX(l2, splat(1e-16f))) : zero;
        nx[k] = -ey * inv;
        ny[k] = ex * inv;
        level[k] = nx[k] * fx[k] + ny[k] * fy[k] - slack;
        turn += x[k] * y[j] - x[j] * y[k];
    }
    const T way = turn < 0.0f ? -one : one;
    for (int k = 0; k < RING; ++k) {
        const int j = k + 1 < RING ? k + 1 : 0;
        ox[k] = way * (y[k] - y[j]);
        oy[k] = way * (x[j] - x[k]);
        bound[k] = ox[k] * x[k] + oy[k] * y[k];
    }
    for (int i = 0; i < RING; ++i) {
        const I here = m & (count > (I)i), back = (count == (I)2) & (i == 1 ? YES : NO);
        if (!VANY(here)) continue;
        // the last side goes back to the first corner
        const int j = i + 1 < RING ? i + 1 : 0;
        const T dx = x[j] - x[i], dy = y[j] - y[i], dz = z[j] - z[i];
        const I closing = count == (I)(i + 1);
        const T ex = closing ? x[0] - x[i] : dx, ey = closing ? y[0] - y[i] : dy, ez = closing ? z[0] - z[i] : dz;
        T lo = zero, hi = one;
        for (int k = 0; k < RING; ++k) {
            const T at = nx[k] * x[i] + ny[k] * y[i] - level[k], by = nx[k] * ex + ny[k] * ey, t = -at / (by == 0.0f ? one : by);
            lo = by > 0.0f ? VMAX(lo, t) : lo;
            hi = by < 0.0f ? VMIN(hi, t) : hi;
            hi = ((by == 0.0f) & (at < 0.0f)) ? -one : hi;
        }
        const I in = here & (lo <= hi) & VNOT(back & (lo > 0.0f));
        const T z0 = z[i] + lo * ez, z1 = z[i] + hi * ez;
        keep_point(p, in & (z0 < margin), x[i] + lo * ex, y[i] + lo * ey, z0);
        keep_point(p, in & (hi < 1.0f) & VNOT(back) & (z1 < margin), x[i] + hi * ex, y[i] + hi * ey, z1);
    }
    // the ring's plane over the face: from its largest triangle with the first corner
    T best = zero, sx = zero, sy = zero;
    for (int k = 2; k < RING; ++k) {
        const T ax = x[k - 1] - x[0], ay = y[k - 1] - y[0], bx = x[k] - x[0], by = y[k] - y[0], det = ax * by - ay * bx;
        const T az = z[k - 1] - z[0], bz = z[k] - z[0];
        const I m2 = VABS(det) > best;
        const T inv = 1.0f / (det == 0.0f ? one : det);
        best = m2 ? VABS(det) : best;
        sx = m2 ? (az * by - ay * bz) * inv : sx;
        sy = m2 ? (ax * bz - az * bx) * inv : sy;
    }
    const I wide = m & (count > (I)2) & (best > 0.0f);
    if (!VANY(wide)) return;
    for (int k = 0; k < RING; ++k) {
        const int j = k ? k - 1 : RING - 1;
        I in = wide & ((k == 0 ? YES : NO) | (fx[k] != fx[j]) | (fy[k] != fy[j]));
        for (int i = 0; i < RING; ++i) {
            const I side = (ox[i] != 0.0f) | (oy[i] != 0.0f);
            in = in & VNOT(side & (ox[i] * fx[k] + oy[i] * fy[k] <= bound[i] + slack * (VABS(ox[i]) + VABS(oy[i]))));
            if (!VANY(in)) break;
        }
        const T height = z[0] + sx * (fx[k] - x[0]) + sy * (fy[k] - y[0]);
        keep_point(p, in & (height < margin), fx[k], fy[k], height);
    }
}
// Lanes whose contact was replaced by several, or by one where the face has it
FN I manifold(World& w, int pair, const Shapes& s, I touch, V3 n) {
    const T margin = splat(pair_margin[pair]), zero = splat(0.0f);
    Ring a, b;
    feature(s.kind1, s.g1, s.s1, n, a);
    feature(s.kind2, s.g2, s.s2, along_axes(s.r, n * splat(-1.0f)), b);
    place(s, b);
    const I one = touch & (a.count > (I)2) & (dot(n, a.normal) > 0.99f), two = touch & (b.count > (I)2) & (dot(n, b.normal) < -0.99f);
    if (!VANY(one | two)) return NO;
    const V3 back = b.normal * splat(-1.0f);
    const I both = one & two & (dot(a.normal, back) > 0.996f);  // then the second's normal is the way, as in MuJoCo
    const I first = one & (both | VNOT(two & (apart(s, back) > apart(s, a.normal))));
    Ring face = b, other;
    other.count = (I)0;
    for (int k = 0; k < RING; ++k) other.at[k] = b.at[k];
    if (VANY(first)) {
        feature(s.kind2, s.g2, s.s2, along_axes(s.r, a.normal * splat(-1.0f)), other);
        place(s, other);
        for (int k = 0; k < RING; ++k) face.at[k] = choose(first, a.at[k], b.at[k]);
        face.normal = choose(first, a.normal, b.normal);
    }
    const I second = two & VNOT(first);
    if (VANY(second)) {
        feature(s.kind1, s.g1, s.s1, back, a);
        for (int k = 0; k < RING; ++k) other.at[k] = choose(second, a.at[k], other.at[k]);
        other.count = second ? a.count : other.count;
    }
    const V3 m = face.normal, way = choose(both, back, m), o = face.at[0], u = unit(face.at[1] - o), v = cross(m, u);
    const V3 round = n * (first ? zero - s.round2 : s.round1);  // capsules touch beside their axis
    const T lean = dot(way, m);  // from a point of the face to the other's plane
    T fx[RING], fy[RING], x[RING], y[RING], z[RING], size = zero;
    for (int k = 0; k < RING; ++k) {
        const V3 f = face.at[k] - o, q = other.at[k] + round - o;
        fx[k] = dot(f, u);
        fy[k] = dot(f, v);
        x[k] = dot(q, u);
        y[k] = dot(q, v);
        z[k] = dot(q, m) * lean;
        size = VMAX(size, VABS(fx[k]) + VABS(fy[k]));
    }
    Points p;
    clip_ring(fx, fy, x, y, z, other.count, one | two, 1e-6f * size, margin, p);
    if (!p.count) return NO;
    // the deepest point, the farthest from it, the farthest from their line, the farthest outside of these three
    const T least = 1e-5f * size;
    T px[4], py[4], pz[4];
    I on[4] = {NO, NO, NO, NO};
    for (int k = 0; k < 4; ++k) px[k] = py[k] = pz[k] = zero;
    for (int k = 0; k < 4; ++k) {
        const T lx = px[1] - px[0], ly = py[1] - py[0];
        T most = k > 1 ? least * VSQRT(lx * lx + ly * ly) : k ? least * least : splat(-1e10f);
        for (int i = 0; i < p.count; ++i) {
            const T dx = p.x[i] - px[0], dy = p.y[i] - py[0], ax = px[1] - px[0], ay = py[1] - py[0];
            T gain;
            if (k == 0) gain = zero - p.z[i];
            else if (k == 1) gain = dx * dx + dy * dy;
            else if (k == 2) gain = VABS(ax * dy - ay * dx);
            else {
                const T bx = px[2] - px[0], by = py[2] - py[0], turn = ax * by - ay * bx, way = turn < 0.0f ? splat(-1.0f) : splat(1.0f);
                const T e0 = -way * (ax * dy - ay * dx), e2 = way * (bx * dy - by * dx);
                const T e1 = -way * ((bx - ax) * (dy - ay) - (by - ay) * (dx - ax));
                gain = VMAX(e0, VMAX(e1, e2));
            }
            const I better = p.on[i] & (k ? on[k - 1] : YES) & (gain > most);
            most = better ? (k ? gain * 1.00001f : gain + least) : most;
            px[k] = better ? p.x[i] : px[k];
            py[k] = better ? p.y[i] : py[k];
            pz[k] = better ? p.z[i] : pz[k];
            on[k] = on[k] | better;
        }
    }
    if (s.kind1 == CAPSULE) {  // as MuJoCo: twice where only one end is low enough
        const I twice = on[0] & VNOT(on[1]);
        px[1] = twice ? px[0] : px[1];
        py[1] = twice ? py[0] : py[1];
        pz[1] = twice ? pz[0] : pz[1];
        on[1] = on[1] | twice;
    }
    const V3 normal = in_world(w.gmat[s.g1], choose(first, way, m * splat(-1.0f))), t = tangent(normal);
    for (int k = 0; k < 4; ++k) {
        const V3 at = o + u * px[k] + v * py[k] + way * (0.5f * pz[k]);
        if (VANY(on[k])) put(w, pair, on[k], pz[k], in_world(w.gmat[s.g1], at) + load(w.gpos[s.g1]), normal, t);
    }
    return on[0];
}
