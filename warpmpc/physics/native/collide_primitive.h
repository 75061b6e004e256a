// SPDX-License-Identifier: Apache-2.0
// Pairs of simple shapes with closed formulas: the contacts of MuJoCo, with masks instead of branches, one world per lane.
//
// Rules: MuJoCo's engine_collision_primitive.c and engine_collision_box.c (sphere and capsule against box). Shapes come in
// MuJoCo's order: plane, sphere, capsule, ellipsoid, cylinder, box. After collide_common.h.

// ---- a plane: normal z of geom 1, contacts half way between the lowest points and the plane

INLINE void touch_plane(World& w, int pair, I m, V3 p, T dist, V3 n, V3 t) {
    const I on = m & (dist < pair_margin[pair]);
    if (VANY(on)) put(w, pair, on, dist, p - n * (0.5f * dist), n, t);
}

FN void plane_sphere(World& w, int pair, int g1, int g2, I near) {
    const V3 n = axis_of(w, g1, 2), p = load(w.gpos[g2]);
    const T r = gsize(w, g2, 0);
    touch_plane(w, pair, near, p - n * r, dot(p - load(w.gpos[g1]), n) - r, n, tangent(n));
}

// both ends; the first tangent follows the capsule
FN void plane_capsule(World& w, int pair, int g1, int g2, I near) {
    const V3 n = axis_of(w, g1, 2), a = axis_of(w, g2, 2), p = load(w.gpos[g2]);
    const T r = gsize(w, g2, 0), h = gsize(w, g2, 1);
    const T c = dot(p - load(w.gpos[g1]), n) - r, up = dot(a, n);
    if (!VANY(near & (c - VABS(up) * h < pair_margin[pair]))) return;
    const V3 flat = a - n * up;
    const T l2 = dot(flat, flat);
    // standing: MuJoCo normalizes a zero vector to x
    const V3 x = {1.0f - n.x * n.x, -n.y * n.x, -n.z * n.x};
    const I standing = l2 < 1e-12f, x_is_normal = dot(x, x) < 1e-6f;
    V3 t = choose(standing, x, flat);
    t = t * (1.0f / VSQRT(VMAX(dot(t, t), splat(1e-12f))));
    t = choose(standing & x_is_normal, tangent(n), t);
    touch_plane(w, pair, near, p + a * h - n * r, c + up * h, n, t);
    touch_plane(w, pair, near, p - a * h - n * r, c - up * h, n, t);
}

// up to four of the corners in the lower half. With axes sorted by the height a0 <= a1 <= a2 of their half edges these are
// the lowest corner, its neighbours over axes 0 and 1, and the one over both or, when a2 is less than a0 + a1, that over 2.
FN void plane_box(World& w, int pair, int g1, int g2, I near) {
    const V3 n = axis_of(w, g1, 2), p = load(w.gpos[g2]);
    const T c = dot(p - load(w.gpos[g1]), n);
    T a[3];
    V3 e[3];
    V3 low = p;
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const V3 half = axis_of(w, g2, k) * gsize(w, g2, k);
        const T rise = dot(half, n);
        e[k] = choose(rise < 0.0f, half * splat(-1.0f), half);
        a[k] = VABS(rise);
        low = low - e[k];
    }
    const T lowest = -(a[0] + a[1] + a[2]), dist = c + lowest;
    const I on = near & (dist < pair_margin[pair]);
    if (!VANY(on)) return;
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const int i = k == 1 ? 1 : 0, j = i + 1;
        const I swap = a[j] < a[i];
        const V3 low_e = choose(swap, e[j], e[i]), high_e = choose(swap, e[i], e[j]);
        const T low_a = VMIN(a[i], a[j]), high_a = VMAX(a[i], a[j]);
        e[i] = low_e;
        e[j] = high_e;
        a[i] = low_a;
        a[j] = high_a;
    }
    const V3 t = tangent(n);
    touch_plane(w, pair, on, low, dist, n, t);
    touch_plane(w, pair, on, low + e[0] * splat(2.0f), dist + 2.0f * a[0], n, t);
    touch_plane(w, pair, on, low + e[1] * splat(2.0f), dist + 2.0f * a[1], n, t);
    const I both = a[2] > a[0] + a[1];
    touch_plane(w, pair, on, low + choose(both, e[0] + e[1], e[2]) * splat(2.0f), dist + 2.0f * (both ? a[0] + a[1] : a[2]), n, t);
}

// the lowest point of the lower rim, the one above it on the upper rim, two more of the lower rim at 120 degrees
FN void plane_cylinder(World& w, int pair, int g1, int g2, I near) {
    const V3 n = axis_of(w, g1, 2), p = load(w.gpos[g2]), z = axis_of(w, g2, 2);
    const T r = gsize(w, g2, 0), h = gsize(w, g2, 1);
    const T rise = dot(n, z);
    const V3 down = choose(rise > 0.0f, z * splat(-1.0f), z);  // along the axis, towards the plane
    const T sink = -VABS(rise), c = dot(p - load(w.gpos[g1]), n);
    const V3 c1 = cross(down, n), across = cross(down, c1);  // across the axis, towards the plane
    const T l2 = dot(c1, c1);
    const V3 out = choose(l2 < 1e-12f, axis_of(w, g2, 0), across * (1.0f / VSQRT(VMAX(l2, splat(1e-12f)))));
    const T fall = dot(out, n) * r;
    const V3 rim = p + out * r, end = down * h, t = tangent(n), side = cross(out, down) * (r * 0.8660254f);
    const T dist = c + sink * h + fall;
    const I on = near & (dist < pair_margin[pair]);
    if (!VANY(on)) return;
    touch_plane(w, pair, on, rim + end, dist, n, t);
    touch_plane(w, pair, on, rim - end, c - sink * h + fall, n, t);
    const V3 back = p + end - out * (0.5f * r);
    const T third = c + sink * h - 0.5f * fall;
    touch_plane(w, pair, on, back + side, third, n, t);
    touch_plane(w, pair, on, back - side, third, n, t);
}

FN void plane_ellipsoid(World& w, int pair, int g1, int g2, I near) {
    const V3 n = axis_of(w, g1, 2), p = load(w.gpos[g2]), d = along_axes(w.gmat[g2], n);
    const V3 s = {gsize(w, g2, 0), gsize(w, g2, 1), gsize(w, g2, 2)};
    const V3 q = {s.x * d.x, s.y * d.y, s.z * d.z};
    const T l = VSQRT(dot(q, q)), inv = -1.0f / l;
    const V3 deepest = {s.x * q.x * inv, s.y * q.y * inv, s.z * q.z * inv};
    touch_plane(w, pair, near, p + in_world(w.gmat[g2], deepest), dot(p - load(w.gpos[g1]), n) - l, n, tangent(n));
}

// ---- spheres and capsules

// a sphere at a and one at b; where the centres are the same, along z of geom 1 x z of geom 2, else x
INLINE void balls(World& w, int pair, int g1, int g2, I m, V3 a, T ra, V3 b, T rb) {
    const V3 d = b - a;
    const T l2 = dot(d, d), reach = ra + rb + pair_margin[pair];
    const I on = m & (l2 < reach * reach);
    if (!VANY(on)) return;
    const T l = VSQRT(l2);
    V3 n = d * (1.0f / VMAX(l, splat(1e-10f)));
    const I same = l < 1e-10f;
    if (VANY(same)) {
        const V3 c = cross(axis_of(w, g1, 2), axis_of(w, g2, 2)), x = {splat(1.0f), splat(0.0f), splat(0.0f)};
        const T c2 = dot(c, c);
        n = choose(same, choose(c2 > 1e-12f, c * (1.0f / VSQRT(VMAX(c2, splat(1e-12f)))), x), n);
    }
    const T dist = l - ra - rb;
    put(w, pair, on, dist, a + n * (ra + 0.5f * dist), n, tangent(n));
}

FN void sphere_sphere(World& w, int pair, int g1, int g2, I near) {
    balls(w, pair, g1, g2, near, load(w.gpos[g1]), gsize(w, g1, 0), load(w.gpos[g2]), gsize(w, g2, 0));
}

FN void sphere_capsule(World& w, int pair, int g1, int g2, I near) {
    const V3 p = load(w.gpos[g1]), q = load(w.gpos[g2]), z = axis_of(w, g2, 2);
    const T s = clip(dot(p - q, z), gsize(w, g2, 1));
    balls(w, pair, g1, g2, near, p, gsize(w, g1, 0), q + z * s, gsize(w, g2, 0));
}

// nearest points of the two segments; parallel ones (up to 1e-4 rad): both ends of the part of the first that is beside the
// second, which may be the same point twice (measured with MuJoCo 3.17; 3.12 and earlier took ends only when exactly parallel)
FN void capsule_capsule(World& w, int pair, int g1, int g2, I near) {
    const V3 p = load(w.gpos[g1]), q = load(w.gpos[g2]);
    const T h1 = gsize(w, g1, 1), h2 = gsize(w, g2, 1), r1 = gsize(w, g1, 0), r2 = gsize(w, g2, 0);
    const V3 a = axis_of(w, g1, 2) * h1, b = axis_of(w, g2, 2) * h2, d = q - p, n = cross(a, b);
    const T aa = h1 * h1, bb = h2 * h2, ab = dot(a, b), ad = dot(a, d), bd = dot(b, d), det = dot(n, n);
    const T one = splat(1.0f), ia = 1.0f / aa, ib = 1.0f / bb;
    const I parallel = det < 1e-8f * aa * bb;
    // p + s a and q + t b; from triple products, which keep their digits when the lines are nearly parallel
    const T inv = 1.0f / VMAX(det, splat(1e-30f));
    T s = dot(cross(d, b), n) * inv, t = dot(cross(d, a), n) * inv;
    const T s1 = clip(s, one);
    t = s == s1 ? t : (ab * s1 - bd) * ib;
    const T t1 = clip(t, one);
    s = t == t1 ? s1 : clip((ab * t1 + ad) * ia, one);
    s = parallel ? clip((ad + ab) * ia, one) : s;
    t = parallel ? clip((ab * s - bd) * ib, one) : t1;
    balls(w, pair, g1, g2, near, p + a * s, r1, q + b * t, r2);
    const I both = near & parallel;
    if (!VANY(both)) return;
    s = clip((ad - ab) * ia, one);
    balls(w, pair, g1, g2, both, p + a * s, r1, q + b * clip((ab * s - bd) * ib, one), r2);
}

// against the mantle, a cap or the rim
FN void sphere_cylinder(World& w, int pair, int g1, int g2, I near) {
    const V3 p = load(w.gpos[g1]), q = load(w.gpos[g2]), z = axis_of(w, g2, 2), d = p - q;
    const T r1 = gsize(w, g1, 0), r = gsize(w, g2, 0), h = gsize(w, g2, 1);
    const T x = dot(d, z);
    const V3 out = d - z * x;
    const T l = VSQRT(dot(out, out));
    const I beside = VABS(x) < h, over = l < r;
    // inside both: what is nearer
    const I cap = over & VNOT(beside & (h - VABS(x) >= r - l)), mantle = beside & VNOT(cap);
    const V3 up = choose(x > 0.0f, z, z * splat(-1.0f));
    const V3 away = out * (1.0f / VMAX(l, splat(1e-10f)));
    // the rim is a point
    const V3 to = up * h + away * r - d;
    const T lr = VSQRT(dot(to, to));
    V3 n = choose(cap, up * splat(-1.0f), choose(mantle, away * splat(-1.0f), to * (1.0f / VMAX(lr, splat(1e-10f)))));
    const T dist = (cap ? VABS(x) - h : mantle ? l - r : lr) - r1;
    const I on = near & (dist < pair_margin[pair]);
    if (!VANY(on)) return;
    const I same = VNOT(cap) & ((mantle ? l : lr) < 1e-10f);
    if (VANY(same)) {
        const V3 c = cross(axis_of(w, g1, 2), z), e = {splat(1.0f), splat(0.0f), splat(0.0f)};
        const T c2 = dot(c, c);
        n = choose(same, choose(c2 > 1e-12f, c * (1.0f / VSQRT(VMAX(c2, splat(1e-12f)))), e), n);
    }
    put(w, pair, on, dist, p + n * (r1 + 0.5f * dist), n, tangent(n));
}

// ---- sphere and capsule against a box

// a sphere with centre c along the box's axes: from the nearest point of the box, or inside out of the nearest face
INLINE void ball_in_box(World& w, int pair, int g2, I m, V3 c, T rad) {
    const V3 s = {gsize(w, g2, 0), gsize(w, g2, 1), gsize(w, g2, 2)};
    const V3 k = {clip(c.x, s.x), clip(c.y, s.y), clip(c.z, s.z)}, f = k - c;
    const T l = VSQRT(dot(f, f));
    const I on = m & (l - rad < pair_margin[pair]);
    if (!VANY(on)) return;
    const I in = l <= 1e-6f * (s.x + s.y + s.z);
    const T ex = s.x - VABS(c.x), ey = s.y - VABS(c.y), ez = s.z - VABS(c.z), least = VMIN(ex, VMIN(ey, ez));
    const I ix = ex == least, iy = VNOT(ix) & (ey == least), iz = VNOT(ix | iy);
    const T one = splat(1.0f), zero = splat(0.0f), inv = 1.0f / VMAX(l, splat(1e-10f));
    const V3 inwards = {ix ? (c.x > 0.0f ? -one : one) : zero, iy ? (c.y > 0.0f ? -one : one) : zero, iz ? (c.z > 0.0f ? -one : one) : zero};
    const V3 n = choose(in, inwards, f * inv);
    const T dist = in ? -least - rad : l - rad;
    const V3 at = c + n * (rad + 0.5f * dist), world = in_world(w.gmat[g2], n);
    put(w, pair, on, dist, in_world(w.gmat[g2], at) + load(w.gpos[g2]), world, tangent(world));
}

FN void sphere_box(World& w, int pair, int g1, int g2, I near) {
    ball_in_box(w, pair, g2, near, along_axes(w.gmat[g2], load(w.gpos[g1]) - load(w.gpos[g2])), gsize(w, g1, 0));
}

// MuJoCo's capsule-box: the point of the segment that is nearest to the box (an end over a face, or one of the twelve
// edges), then a second point along the segment as far as it stays over the box; a sphere against the box at both
FN void capsule_box(World& w, int pair, int g1, int g2, I near) {
    const T* rot = w.gmat[g2];
    const T rad = gsize(w, g1, 0), h = gsize(w, g1, 1), s[3] = {gsize(w, g2, 0), gsize(w, g2, 1), gsize(w, g2, 2)};
    const V3 q = along_axes(rot, load(w.gpos[g1]) - load(w.gpos[g2])), a = along_axes(rot, axis_of(w, g1, 2));
    const T p[3] = {q.x, q.y, q.z}, ax[3] = {a.x, a.y, a.z}, ha[3] = {a.x * h, a.y * h, a.z * h};
    const T zero = splat(0.0f), one = splat(1.0f);
    {  // its box along the other's axes
        const T r = rad + pair_margin[pair];
        const I on = near & (VABS(p[0]) - VABS(ha[0]) < s[0] + r) & (VABS(p[1]) - VABS(ha[1]) < s[1] + r) & (VABS(p[2]) - VABS(ha[2]) < s[2] + r);
        if (!VANY(on)) return;
        near = on;
    }
    // best: squared distance; seg, along: where on the segment and on the box's edge, in -1 to 1
    // type -3, -1: an end, over `face` (or -1: inside); 0 to 8: 3 * (place on the box's edge) + (place on the segment), both 0, 1, 2
    T best = 4.0f * (rad + h + s[0] + s[1] + s[2]) * (rad + h + s[0] + s[1] + s[2]), seg = zero, along = zero;
    I type = (I)(-4), face = (I)(-1), corner = (I)0, edge = (I)0;
#pragma unroll
    for (int e = -1; e < 2; e += 2) {
        I one_out = (I)0, more_out = (I)0, axis = (I)(-1);
        T d2 = zero;
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            const T over = VMAX(VABS(p[j] + (float)e * ha[j]) - s[j], zero);
            const I o = over > 0.0f;
            more_out = more_out | (one_out & o);
            one_out = one_out | o;
            axis = o ? (I)j : axis;
            d2 = d2 + over * over;
        }
        const I m = VNOT(more_out) & (d2 < best);
        best = m ? d2 : best;
        seg = m ? splat((float)e) : seg;
        type = m ? (I)(e - 2) : type;
        face = m ? axis : face;
    }
    const T mc = h * h, imc = 1.0f / mc;
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        const int j1 = (j + 1) % 3, j2 = (j + 2) % 3;
        const T ma = s[j] * s[j], mb = -s[j] * ha[j], det = ma * (ha[j1] * ha[j1] + ha[j2] * ha[j2]);
        const I valid = det > 1e-7f * ma * mc;
        const T idet = 1.0f / VMAX(det, splat(1e-20f)), ima = 1.0f / ma;
#if defined(__CUDA_ARCH__)
#pragma unroll 1  // a GPU reads instructions more slowly than it runs them
#endif
        for (int i = 0; i < 4; ++i) {
            const T dj = -p[j], d1 = (i & 1 ? s[j1] : -s[j1]) - p[j1], d2 = (i & 2 ? s[j2] : -s[j2]) - p[j2];
            const T u = -s[j] * dj, v = ha[j] * dj + ha[j1] * d1 + ha[j2] * d2;
            T x1 = (mc * u - mb * v) * idet, x2 = (ma * v - mb * u) * idet;
            const I hi = x1 > 1.0f, lo = x1 < -1.0f;
            x2 = hi ? (v - mb) * imc : lo ? (v + mb) * imc : x2;
            x1 = clip(x1, one);
            const I o2 = x2 > 1.0f, u2 = x2 < -1.0f;
            x1 = o2 ? (u - mb) * ima : u2 ? (u + mb) * ima : x1;
            x2 = clip(x2, one);
            // a place at an end of the edge stays one unless the other end takes it, as in MuJoCo
            const I over = x1 > 1.0f, under = x1 < -1.0f, top = over | (hi & VNOT(under)), bottom = under | (lo & VNOT(over));
            x1 = clip(x1, one);
            const T ej = dj - ha[j] * x2 + s[j] * x1, e1 = d1 - ha[j1] * x2, e2 = d2 - ha[j2] * x2;
            const T l2 = ej * ej + e1 * e1 + e2 * e2;
            const I m = valid & (l2 < best - 2e-6f * best - 1e-12f);
            const int low = (i & 1 ? 1 << j1 : 0) + (i & 2 ? 1 << j2 : 0);
            best = m ? l2 : best;
            seg = m ? x2 : seg;
            along = m ? x1 : along;
            corner = m ? (top ? (I)(low + (1 << j)) : (I)low) : corner;
            edge = m ? (I)j : edge;
            const I place = o2 ? (I)2 : u2 ? (I)0 : (I)1;
            type = m ? (top ? place + (I)6 : bottom ? place : place + (I)3) : type;
        }
    }
    const I none = (I)0;
    const I dir = (ha[0] > 0.0f ? (I)1 : none) | (ha[1] > 0.0f ? (I)2 : none) | (ha[2] > 0.0f ? (I)4 : none);
    const I at_edge = (type >= (I)3) & (type <= (I)5), at_corner = (type >= none) & VNOT(at_edge);
    const I at_face = (type < none) & (type > (I)(-4)) & (face != (I)(-1));
    T second = splat(-4.0f), r[3];
    for (int k = 0; k < 3; ++k) r[k] = s[k] / VMAX(VABS(ha[k]), splat(1e-9f));
    {  // nearest at a corner: along an edge or a face of the box, if the segment runs neither away from nor into the corner
        I c = dir ^ corner;
        const I use = at_corner & (c != none) & (c != (I)7), single = (c == (I)1) | (c == (I)2) | (c == (I)4);
        const T mul = single ? one : -one;
        c = single ? c : (I)7 - c;
        const I c0 = c == (I)1, c1 = c == (I)2;
        const T axk = c0 ? ax[0] : c1 ? ax[1] : ax[2], rk = c0 ? r[0] : c1 ? r[1] : r[2];
        const T ro = c0 ? VMIN(r[1], r[2]) : c1 ? VMIN(r[0], r[2]) : VMIN(r[0], r[1]);
        const T x = axk * axk > 0.5f ? VMIN(1.0f - mul * seg, 2.0f * rk) : -VMIN(1.0f + mul * seg, 2.0f * ro);
        second = use ? x * mul : second;
    }
    {  // at an edge which it crosses: over the face that it is more parallel to
        const I e0 = edge == (I)0, e1 = edge == (I)1, bit = e0 ? (I)1 : e1 ? (I)2 : (I)4;
        const I c = (dir ^ corner) & ((I)7 - bit);
        const I use = at_edge & ((c == (I)1) | (c == (I)2) | (c == (I)4));
        const I aa = e0 ? (I)1 : e1 ? (I)2 : (I)0, ab = e0 ? (I)2 : e1 ? (I)0 : (I)1;
        const T va = e0 ? VABS(ax[1]) : e1 ? VABS(ax[2]) : VABS(ax[0]), vb = e0 ? VABS(ax[2]) : e1 ? VABS(ax[0]) : VABS(ax[1]);
        const I a2 = va > vb ? aa : ab;
        const T r2 = a2 == (I)0 ? r[0] : a2 == (I)1 ? r[1] : r[2], re = e0 ? r[0] : e1 ? r[1] : r[2];
        const I forth = (c & (a2 == (I)0 ? (I)1 : a2 == (I)1 ? (I)2 : (I)4)) != none, up = (dir & bit) != none;
        const I alike = (forth & up) | VNOT(forth | up);
        T x = VMIN(2.0f * r2, forth ? 1.0f - seg : 1.0f + seg);
        x = VMIN(re * (alike ? 1.0f - along : 1.0f + along), x);
        second = use ? (forth ? x : -x) : second;
    }
    {  // an end over a face: towards the other end, until it leaves the face
        const T mul = type == (I)(-3) ? one : -one;
        T x = splat(2.0f);
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            const T t = p[i] - ha[i] * mul, inv = mul / (VABS(ha[i]) > 1e-9f ? ha[i] : splat(1e-9f));
            const I other = face != (I)i;
            const T y0 = (s[i] - t) * inv, y1 = (-s[i] - t) * inv;
            x = (other & (y0 > 0.0f) & (y0 < x)) ? y0 : x;
            x = (other & (y1 > 0.0f) & (y1 < x)) ? y1 : x;
        }
        second = at_face ? x * mul : second;
    }
    const I on = near & (type != (I)(-4));
    const T t = seg + second;
    ball_in_box(w, pair, g2, on, q + a * (h * seg), rad);
    ball_in_box(w, pair, g2, on & (second > -3.0f), q + a * (h * t), rad);
}
