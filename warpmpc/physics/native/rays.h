// SPDX-License-Identifier: Apache-2.0
// Rays against shapes, and points within them, in the shapes' own axes (MuJoCo, "Computation: Sensors"). A ray that
// misses is at -1.

// The nearer of two places along a ray, of which those below zero are none
INLINE T nearer(T a, T b) { return ((b >= 0.0f) & ((a < 0.0f) | (b < a))) ? b : a; }
// Where p + x d enters and leaves the ball of a radius; in two dimensions a circle
INLINE I cuts(V3 p, V3 d, T radius, T& enters, T& leaves) {
    const T square = dot(d, d), scale = 1.0f / VMAX(square, splat(1e-12f)), middle = -dot(p, d) * scale;
    const V3 off = p + d * middle;
    const T left = radius * radius - dot(off, off), half = VSQRT(VMAX(left, zero()) * scale);
    enters = middle - half;
    leaves = middle + half;
    return (left >= 0.0f) & (square > 1e-12f);
}
INLINE T first_cut(V3 p, V3 d, T radius) {
    T enters, leaves;
    const I cut = cuts(p, d, radius, enters, leaves);
    const T at = enters >= 0.0f ? enters : leaves;
    return (cut & (at >= 0.0f)) ? at : splat(-1.0f);
}
// Where it meets a face across an axis, between bounds along the two others
INLINE T cut_face(T p, T d, T face, T p1, T d1, T most1, T p2, T d2, T most2) {
    const T at = (face - p) / (VABS(d) > 1e-12f ? d : splat(1e-12f));
    const I in = (VABS(p1 + at * d1) <= most1 * 1.000001f) & (VABS(p2 + at * d2) <= most2 * 1.000001f);
    return (in & (at >= 0.0f) & (VABS(d) > 1e-12f)) ? at : splat(-1.0f);
}
INLINE T ray_box(V3 p, V3 d, V3 s) {
    T out = splat(-1.0f);
    for (int side = -1; side <= 1; side += 2) {
        const float f = side;
        out = nearer(out, cut_face(p.x, d.x, s.x * f, p.y, d.y, s.y, p.z, d.z, s.z));
        out = nearer(out, cut_face(p.y, d.y, s.y * f, p.x, d.x, s.x, p.z, d.z, s.z));
        out = nearer(out, cut_face(p.z, d.z, s.z * f, p.x, d.x, s.x, p.y, d.y, s.y));
    }
    return out;
}
// The round side of a cylinder
INLINE T ray_side(V3 p, V3 d, T radius, T half) {
    const T at = first_cut({p.x, p.y, zero()}, {d.x, d.y, zero()}, radius);
    return VABS(p.z + at * d.z) <= half * 1.000001f ? at : splat(-1.0f);
}
INLINE T ray_capsule(V3 p, V3 d, T radius, T half) {
    T out = ray_side(p, d, radius, half);
    for (int side = -1; side <= 1; side += 2) {
        const float f = side;
        const V3 from = {p.x, p.y, p.z - half * f};
        T at[2];
        const I cut = cuts(from, d, radius, at[0], at[1]);
        for (int k = 0; k < 2; ++k)  // the half of the ball that is beyond the side
            out = nearer(out, (cut & ((from.z + at[k] * d.z) * f >= 0.0f)) ? at[k] : splat(-1.0f));
    }
    return out;
}
INLINE T ray_cylinder(V3 p, V3 d, T radius, T half) {
    T out = ray_side(p, d, radius, half);
    for (int side = -1; side <= 1; side += 2) {
        const T at = (half * (float)side - p.z) / (VABS(d.z) > 1e-12f ? d.z : splat(1e-12f));
        const T x = p.x + at * d.x, y = p.y + at * d.y;
        out = nearer(out, ((x * x + y * y <= radius * radius) & (VABS(d.z) > 1e-12f)) ? at : splat(-1.0f));
    }
    return out;
}
// A plane is seen from above, within its size where it has one
INLINE T ray_plane(V3 p, V3 d, V3 s) {
    const T at = -p.z / (d.z < -1e-12f ? d.z : splat(-1e-12f));
    const I in = ((s.x <= 0.0f) | (VABS(p.x + at * d.x) <= s.x)) & ((s.y <= 0.0f) | (VABS(p.y + at * d.y) <= s.y));
    return (in & (at >= 0.0f) & (d.z < -1e-12f)) ? at : splat(-1.0f);
}
INLINE T ray_ellipsoid(V3 p, V3 d, V3 s) {
    return first_cut({p.x / s.x, p.y / s.y, p.z / s.z}, {d.x / s.x, d.y / s.y, d.z / s.z}, splat(1.0f));
}
FN T ray_shape(int kind, V3 p, V3 d, V3 s) {
    switch (kind) {
        case RAY_PLANE: return ray_plane(p, d, s);
        case RAY_SPHERE: return first_cut(p, d, s.x);
        case RAY_CAPSULE: return ray_capsule(p, d, s.x, s.y);
        case RAY_ELLIPSOID: return ray_ellipsoid(p, d, s);
        case RAY_CYLINDER: return ray_cylinder(p, d, s.x, s.y);
        default: return ray_box(p, d, s);
    }
}
FN I inside(int kind, V3 p, V3 s) {
    const T round = p.x * p.x + p.y * p.y, beyond = VMAX(VABS(p.z) - s.y, zero());
    const V3 part = {p.x / s.x, p.y / s.y, p.z / s.z};
    switch (kind) {
        case RAY_PLANE: return p.z < 0.0f;
        case RAY_SPHERE: return dot(p, p) < s.x * s.x;
        case RAY_CAPSULE: return round + beyond * beyond < s.x * s.x;
        case RAY_ELLIPSOID: return dot(part, part) < 1.0f;
        case RAY_CYLINDER: return (VABS(p.z) < s.y) & (round < s.x * s.x);
        default: return (VABS(p.x) < s.x) & (VABS(p.y) < s.y) & (VABS(p.z) < s.z);
    }
}
#if RAYS
// Places along a ray where it meets triangles of a mesh, the first of them
INLINE T ray_mesh(int first, int end, V3 p, V3 d) {
    T out = splat(-1.0f);
#if RAY_TRIANGLES
    for (int k = first; k < end; ++k) {
        const float* const corner = ray_triangle + 9 * k;
        const V3 a = vector(corner + 3), b = vector(corner + 6), from = p - vector(corner), across = cross(d, b);
        const T volume = dot(a, across), over = 1.0f / (VABS(volume) > 1e-20f ? volume : splat(1e-20f));
        const V3 turned = cross(from, a);
        const T u = dot(from, across) * over, v = dot(d, turned) * over, at = dot(b, turned) * over;
        const I in = (u >= -1e-6f) & (v >= -1e-6f) & (u + v <= 1.000001f) & (VABS(volume) > 1e-20f);
        out = nearer(out, in ? at : splat(-1.0f));
    }
#endif
    return out;
}
// Distances along the z axes of sites to the nearest geom of another body, and what else a sensor tells of such a ray
FN void look(World& w) {
    EACH(r, RAYS) {
        const int site = ray_site[r];
        const V3 from = load(w.site_at[site]);
        const T* const turn = w.site_turn[site];
        const V3 along = {turn[2], turn[5], turn[8]};
        T distance = splat(-1.0f);
        for (int n = 0; n < RAY_GEOMS; ++n) {
            if (ray_geom_body[n] == ray_body[r]) continue;
            const int g = ray_geom[n], own = ray_geom_site[n];
            const V3 to = from - load(w.site_at[own]);
            const float reach = bound(w, g);
            if (reach > 0.0f) {
                const T middle = VMAX(-dot(to, along), zero());
                const V3 off = to + along * middle;
                if (!VANY(dot(off, off) <= reach * reach * 1.00001f)) continue;
            }
            const V3 p = along_axes(w.site_turn[own], to), d = along_axes(w.site_turn[own], along);
            const int first = ray_first[n], end = ray_first[n + 1];
            const T at = end > first ? ray_mesh(first, end, p, d)
                                     : ray_shape(ray_kind[n], p, d, {gsize(w, g, 0), gsize(w, g, 1), gsize(w, g, 2)});
            distance = nearer(distance, at);
        }
        const I hit = distance >= 0.0f;
        const V3 nothing = {zero(), zero(), zero()}, point = choose(hit, from + along * distance, nothing);
        T* to = w.sensed + ray_at[r];
        const int spec = ray_spec[r];
        if (spec & 1) *to++ = distance;
        const V3 rest[3] = {choose(hit, along, nothing), from, point};
        for (int k = 0; k < 3; ++k)
            if (spec & 2 << k) to[0] = rest[k].x, to[1] = rest[k].y, to[2] = rest[k].z, to += 3;
        if (spec & 32) *to = distance;
    }
    SYNC
}
#endif
