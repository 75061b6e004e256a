// SPDX-License-Identifier: Apache-2.0
// Tendons around spheres and cylinders, outside or inside (MuJoCo, "Computation: Tendons").
#if WRAPS
struct V2 {
    T x, y;
    INNER V2 operator+(V2 b) const { return {x + b.x, y + b.y}; }
    INNER V2 operator-(V2 b) const { return {x - b.x, y - b.y}; }
    INNER V2 operator*(T s) const { return {x * s, y * s}; }
};
struct Bend {  // where a tendon meets and leaves a shape, its directions before and after, its length
    V3 first, last, in, out;
    T length;
};
INLINE T dot(V2 a, V2 b) { return a.x * b.x + a.y * b.y; }
INLINE T cross(V2 a, V2 b) { return a.x * b.y - a.y * b.x; }
INLINE V2 choose(I m, V2 a, V2 b) { return {m ? a.x : b.x, m ? a.y : b.y}; }
INLINE V2 unit(V2 a) {
    const T size = VSQRT(dot(a, a));
    const I some = size > 1e-15f;
    const T over = 1.0f / VMAX(size, splat(1e-15f));
    return {some ? a.x * over : splat(1.0f), some ? a.y * over : zero()};
}
// Direction of a way, along x where it has no length
INLINE V3 unit(V3 a, T& size) {
    size = VSQRT(dot(a, a));
    const I some = size > 1e-15f;
    const T over = 1.0f / VMAX(size, splat(1e-15f));
    return {some ? a.x * over : splat(1.0f), some ? a.y * over : zero(), some ? a.z * over : zero()};
}
// Angle in [0, π] of a point whose height is not negative
INLINE T angle_of(T height, T width) {
    const T run = VABS(width);
    ANGLE
    return width < 0.0f ? 3.14159265f - part : part;
}
INLINE T arcsine(T x) { return angle_of(x, VSQRT(VMAX((1.0f - x) * (1.0f + x), zero()))); }
// Signed angle from a to b, in [-π, π]
INLINE T turned(V2 a, V2 b) {
    const T area = cross(a, b), angle = angle_of(VABS(area), dot(a, b));
    return area < 0.0f ? -angle : angle;
}
// Lanes in which the segments from a to b and from c to d meet
INLINE I meet(V2 a, V2 b, V2 c, V2 d) {
    const V2 u = b - a, v = d - c, way = a - c;
    const T det = cross(u, v);
    const I crossing = VABS(det) >= 1e-15f;
    const T over = 1.0f / (crossing ? det : splat(1.0f)), s = cross(v, way) * over, t = cross(u, way) * over;
    return crossing & (s >= 0.0f) & (s <= 1.0f) & (t >= 0.0f) & (t <= 1.0f);
}
// Tangent points of the shorter way around a circle, or of the one on a side; the length of the arc. From MuJoCo 4.0 on
// (SIDES_WIND) the way with a side turns about the centre by as much as the line over the side's point
INLINE I outside(V2 a, V2 b, V2 nearest, T radius, const V2* side, V2& first, V2& last, T& arc) {
    const T aa = dot(a, a), bb = dot(b, b), rr = radius * radius, none = splat(1e-30f);
    I on = (aa >= rr) & (bb >= rr) & (radius >= 1e-15f) & (dot(b - a, b - a) >= 1e-15f);
    const bool winds = SIDES_WIND && side;
    const T swept = winds ? turned(a, *side) + turned(*side, b) : zero();
    const I beyond = winds ? VABS(swept - turned(a, b)) >= 3.14159265f : side ? dot(*side, nearest) < 0.0f : NO;
    on &= VNOT(dot(nearest, nearest) > rr) | beyond;
    const T la = VSQRT(aa), lb = VSQRT(bb);
    const T ra = radius * VSQRT(VMAX((la - radius) * (la + radius), zero())), oa = 1.0f / VMAX(aa, none);
    const T rb = radius * VSQRT(VMAX((lb - radius) * (lb + radius), zero())), ob = 1.0f / VMAX(bb, none);
    T best = zero(), turn = zero();
    I met = NO;
    for (int n = 0; n < 2; ++n) {
        const float sign = n ? -1.0f : 1.0f;
        const V2 p = (a * rr + V2{a.y, -a.x} * (sign * ra)) * oa, q = (b * rr + V2{-b.y, b.x} * (sign * rb)) * ob;
        const I cut = meet(a, p, b, q);
        const T good = cut ? splat(-10000.0f) : side ? dot(unit(p + q), *side) : -dot(p - q, p - q);
        const I better = !n ? YES : winds ? swept > 0.0f : VNOT(best > good);
        best = better ? good : best;
        first = choose(better, p, first), last = choose(better, q, last);
        met = (better & cut) | (VNOT(better) & met);
        turn = better ? splat(sign) * cross(p, q) : turn;
    }
    const T angle = angle_of(VABS(turn), dot(first, last));
    // the long way round, unless rounding makes it of none
    arc = radius * (turn > 1e-6f * rr ? 6.28318531f - angle : angle);
    if (winds) arc = radius * VABS(swept - turned(a, first) - turned(last, b));
    return on & VNOT(met);
}
// The point on a circle that a tendon touches from inside: the angles there with both ends are equal
INLINE I inside(V2 a, V2 b, V2 nearest, I between, T radius, V2& touch) {
    const T la = VSQRT(dot(a, a)), lb = VSQRT(dot(b, b));
    I on = (la > radius) & (lb > radius) & (radius >= 1e-15f);
    on &= VNOT(between & (dot(nearest, nearest) <= radius * radius));
    const T share_a = radius / VMAX(la, splat(1e-15f)), share_b = radius / VMAX(lb, splat(1e-15f));
    const T area = cross(a, b), opening = angle_of(VABS(area), dot(a, b));
    // 2 φ - asin(A sin φ) - asin(B sin φ) = G is convex: Newton's method from above
    T angle = splat(1.57079633f), left = zero(), right = zero();
    I found = on;
    for (int k = 0; k < 20; ++k) {
        SINCOS_ANGLE
        const T s = VMIN(share_a, splat(1.0f)) * sine, t = VMIN(share_b, splat(1.0f)) * sine;
        left = arcsine(s), right = arcsine(t);
        const T over = 2.0f * angle - left - right - opening;
        if (!k) found &= over >= 0.0f;
        const T least = splat(1e-6f);
        const T slope = 2.0f - share_a * cosine / VSQRT(VMAX(1.0f - s * s, least)) - share_b * cosine / VSQRT(VMAX(1.0f - t * t, least));
        const I far = found & (VABS(over) > 2e-7f);
        if (!VANY(far)) break;
        angle = far ? VMAX(angle - over / VMAX(slope, least), zero()) : angle;
    }
    const I ahead = area > 0.0f;
    const V2 from = unit(choose(ahead, a, b));
    angle = angle - (ahead ? left : right);
    SINCOS_ANGLE
    const V2 place = {from.x * cosine - from.y * sine, from.x * sine + from.y * cosine};
    touch = choose(found, place, unit(a + b)) * radius;
    return on;
}
INLINE V3 outward(const T* r, V3 v) {
    return {r[0] * v.x + r[1] * v.y + r[2] * v.z, r[3] * v.x + r[4] * v.y + r[5] * v.z, r[6] * v.x + r[7] * v.y + r[8] * v.z};
}
// Way from one point to another around a shape; straight in lanes where it is not met
FN Bend around(const T* from, const T* to, const T* centre, const T* turn, T radius, int cylinder, const T* side) {
    const V3 c = load(centre), start = load(from), end = load(to);
    const V3 a = along_axes(turn, start - c), b = along_axes(turn, end - c);
    V3 x = {splat(1.0f), zero(), zero()}, y = {zero(), splat(1.0f), zero()};
    if (!cylinder) {  // in the plane of both points and the centre
        T size, far;
        x = unit(a, size);
        unit(b, far);
        const I second = (VABS(x.y) > VABS(x.x)) & (VABS(x.y) > VABS(x.z));
        const I third = (VABS(x.z) > VABS(x.x)) & (VABS(x.z) > VABS(x.y));
        const T one = splat(1.0f);
        const V3 any = {(second | third) ? one : zero(), second ? zero() : one, third ? zero() : one};
        V3 normal = cross(a, b);
        normal = choose(VSQRT(dot(normal, normal)) < 3e-7f * size * far, cross(x, any), normal);
        normal = unit(normal, size);
        y = cross(normal, x);
    }
    const V2 p = {dot(a, x), dot(a, y)}, q = {dot(b, x), dot(b, y)}, way = q - p;
    const T square = dot(way, way), share = -dot(way, p) / VMAX(square, splat(1e-30f));
    const V2 nearest = p + way * VMIN(VMAX(share, zero()), splat(1.0f));
    V2 first = {zero(), zero()}, last = first;
    T arc = zero();
    I on, within = NO;
    V2 beside;
    if (side) {
        const V3 s = along_axes(turn, load(side) - c);
        within = dot(s, s) < radius * radius;
        beside = unit(V2{dot(s, x), dot(s, y)}) * radius;
    }
    on = outside(p, q, nearest, radius, side ? &beside : nullptr, first, last, arc) & VNOT(within);
    if (VANY(within)) {
        V2 touch;
        const I between = (square > 1e-15f) & (share > 0.0f) & (share < 1.0f);
        on |= within & inside(p, q, nearest, between, radius, touch);
        first = choose(within, touch, first), last = choose(within, touch, last);
        arc = within ? zero() : arc;
    }
    V3 f = x * first.x + y * first.y, l = x * last.x + y * last.y;
    if (cylinder) {  // along the axis at an even pitch
        const T before = VSQRT(dot(p - first, p - first)), after = VSQRT(dot(q - last, q - last));
        const T pitch = (b.z - a.z) / VMAX(before + arc + after, splat(1e-15f)), rise = pitch * arc;
        f.z = a.z + pitch * before;
        l.z = f.z + rise;
        arc = VSQRT(arc * arc + rise * rise);
    }
    Bend out;
    T before, after;
    out.first = choose(on, c + outward(turn, f), start), out.last = choose(on, c + outward(turn, l), start);
    out.out = unit(end - out.last, after);
    out.in = choose(on, unit(out.first - start, before), out.out);
    out.length = (on ? before + arc : zero()) + after;
    return out;
}
#endif
