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
#if RAY_NORMALS
// Direction away from a shape at a point of its surface, of any length
FN V3 shape_normal(int kind, V3 h, V3 s) {
    const T none = zero(), one = splat(1.0f), x = VABS(h.x) - s.x, y = VABS(h.y) - s.y, z = VABS(h.z) - s.z;
    V3 n = h;
    switch (kind) {
        case RAY_PLANE: return {none, none, one};
        case RAY_SPHERE: break;
        case RAY_CAPSULE: n.z -= VMIN(VMAX(h.z, -s.y), s.y); break;
        case RAY_ELLIPSOID: n = {h.x / (s.x * s.x), h.y / (s.y * s.y), h.z / (s.z * s.z)}; break;
        case RAY_CYLINDER:
            n = choose(VABS(VABS(h.z) - s.y) < VABS(VSQRT(h.x * h.x + h.y * h.y) - s.x), {none, none, h.z}, {h.x, h.y, none});
            break;
        default: n = choose((x > y) & (x > z), {h.x, none, none}, choose(y > z, {none, h.y, none}, {none, none, h.z}));
    }
    return n;
}
#endif
// Takes on a place along a ray where it is nearer than the one that is known, with its normal
INLINE void take(T at, V3 n, T& nearest, V3& normal) {
    if (RAY_NORMALS) normal = choose((at >= 0.0f) & ((nearest < 0.0f) | (at < nearest)), n, normal);
    nearest = nearer(nearest, at);
}
// Where it meets a triangle, of which `from` is away from a corner and a and b are the edges at that corner
INLINE T cut_triangle(V3 from, V3 a, V3 b, V3 d) {
    const V3 across = cross(d, b), turned = cross(from, a);
    const T volume = dot(a, across), over = 1.0f / (VABS(volume) > 1e-20f ? volume : splat(1e-20f));
    const T u = dot(from, across) * over, v = dot(d, turned) * over, at = dot(b, turned) * over;
    const I in = (u >= -1e-6f) & (v >= -1e-6f) & (u + v <= 1.000001f) & (VABS(volume) > 1e-20f);
    return in ? at : splat(-1.0f);
}
INLINE T ray_mesh(int first, int end, V3 p, V3 d, V3& normal) {
    T out = splat(-1.0f);
#if RAY_TRIANGLES
    for (int k = first; k < end; ++k) {
        const float* const corner = ray_triangle + 9 * k;
        const V3 a = vector(corner + 3), b = vector(corner + 6);
        take(cut_triangle(p - vector(corner), a, b, d), cross(a, b), out, normal);
    }
#endif
    return out;
}
#if RAY_FIELDS
// A heightfield: its base, its sides up to its edge, and the cells that the ray passes over; each lane has its own cells
FN T ray_field(const World& w, int g, V3 p, V3 d, V3& normal) {
    const float* size = field_size + 4 * g;  // half lengths, height and depth
    const int columns = field_columns[g], rows = field_rows[g];
    const float dx = 2.0f * size[0] / (columns - 1), dy = 2.0f * size[1] / (rows - 1);
    const T none = zero(), middle = splat(0.5f * size[2]), x = p.x + size[0], y = p.y + size[1];
    const V3 half = {splat(size[0]), splat(size[1]), splat(0.5f * size[3])}, based = {p.x, p.y, p.z + half.z};
    T out = ray_box(based, d, half);
#if RAY_NORMALS
    normal = shape_normal(RAY_BOX, based + d * out, half);
#endif
    for (int side = 0; side < 4; ++side) {
        const float f = side & 1 ? 1.0f : -1.0f;
        const bool across = side < 2;  // the x axis
        const T at = across ? cut_face(p.x, d.x, half.x * f, p.y, d.y, half.y, p.z - middle, d.z, middle)
                            : cut_face(p.y, d.y, half.y * f, p.x, d.x, half.x, p.z - middle, d.z, middle);
        const T along = across ? (y + at * d.y) * (1.0f / dy) : (x + at * d.x) * (1.0f / dx);
        const I first = VINT(VMIN(VMAX(along, none), splat((float)((across ? rows : columns) - 2))));
        const T part = along - VFLOAT(first);
        const I place = across ? first * (I)columns + (I)(side & 1 ? columns - 1 : 0)
                               : first + (I)(side & 1 ? (rows - 1) * columns : 0);
        const T low = height_at(w, g, place), high = height_at(w, g, place + (I)(across ? columns : 1));
        const V3 away = {splat(across ? f : 0.0f), splat(across ? 0.0f : f), none};
        take(p.z + at * d.z < low + part * (high - low) ? at : splat(-1.0f), away, out, normal);
    }
    T enters = none, leaves = splat(1e10f);
    const T at[3] = {p.x, p.y, p.z - middle}, speed[3] = {d.x, d.y, d.z}, most[3] = {half.x, half.y, middle};
    for (int k = 0; k < 3; ++k) {
        const T over = 1.0f / (VABS(speed[k]) > 1e-12f ? speed[k] : splat(1e-12f));
        const T a = (-most[k] - at[k]) * over, b = (most[k] - at[k]) * over;
        enters = VMAX(enters, VMIN(a, b)), leaves = VMIN(leaves, VMAX(a, b));
    }
    const T over_x = 1.0f / (VABS(d.x) > 1e-12f ? d.x : splat(1e-12f));
    const T over_y = 1.0f / (VABS(d.y) > 1e-12f ? d.y : splat(1e-12f));
    const I last_column = (I)(columns - 2), last_row = (I)(rows - 2), no = (I)0, one = (I)1;
    I c = VINT(VMIN(VMAX((x + enters * d.x) * (1.0f / dx), none), splat((float)(columns - 2))));
    I r = VINT(VMIN(VMAX((y + enters * d.y) * (1.0f / dy), none), splat((float)(rows - 2))));
    I on = enters <= leaves + 1e-6f;
    while (VANY(on)) {
        const I column = on ? c : no, row = on ? r : no, place = row * (I)columns + column;
        const T base = height_at(w, g, place), h01 = height_at(w, g, place + one) - base;
        const T h10 = height_at(w, g, place + (I)columns) - base, h11 = height_at(w, g, place + (I)(columns + 1)) - base;
        const V3 from = {x - VFLOAT(column) * dx, y - VFLOAT(row) * dy, p.z - base};
        const V3 right = {splat(dx), none, h01}, behind = {none, splat(dy), h10}, far = {splat(dx), splat(dy), h11};
        const T first = cut_triangle(from, right, far, d), second = cut_triangle(from, far, behind, d);
        take(on ? first : splat(-1.0f), cross(right, far), out, normal);
        take(on ? second : splat(-1.0f), cross(far, behind), out, normal);
        const T to_x = (VFLOAT(d.x > 0.0f ? column + one : column) * dx - x) * over_x;
        const T to_y = (VFLOAT(d.y > 0.0f ? row + one : row) * dy - y) * over_y;
        const I sideways = to_x < to_y;
        c = sideways ? (d.x > 0.0f ? column + one : column - one) : column;
        r = sideways ? row : (d.y > 0.0f ? row + one : row - one);
        on &= (VMIN(to_x, to_y) <= leaves) & (first < 0.0f) & (second < 0.0f);
        on &= (c >= no) & (c <= last_column) & (r >= no) & (r <= last_row);
    }
    return out;
}
#endif
// Distances along the z axes of sites to the nearest geom of another body, and the other data of a sensor of such a ray
FN void look(World& w) {
    EACH(r, RAYS) {
        const int site = ray_site[r];
        const V3 from = load(w.site_at[site]), nothing = {zero(), zero(), zero()};
        const T* const turn = w.site_turn[site];
        const V3 along = {turn[2], turn[5], turn[8]};
        T distance = splat(-1.0f);
        V3 normal = nothing;
        for (int n = 0; n < RAY_GEOMS; ++n) {
            if (ray_geom_body[n] == ray_body[r]) continue;
            const int g = ray_geom[n], own = ray_geom_site[n], kind = ray_kind[n];
            const V3 to = from - load(w.site_at[own]);
            const float reach = bound(w, g);
            if (reach > 0.0f) {
                const T middle = VMAX(-dot(to, along), zero());
                const V3 off = to + along * middle;
                if (!VANY(dot(off, off) <= reach * reach * 1.00001f)) continue;
            }
            const V3 p = along_axes(w.site_turn[own], to), d = along_axes(w.site_turn[own], along);
            const V3 s = {gsize(w, g, 0), gsize(w, g, 1), gsize(w, g, 2)};
            const int first = ray_first[n], end = ray_first[n + 1];
            V3 facing = nothing;
            T at;
            if (end > first) at = ray_mesh(first, end, p, d, facing);
#if RAY_FIELDS
            else if (kind == RAY_HFIELD) at = ray_field(w, g, p, d, facing);
#endif
            else {
                at = ray_shape(kind, p, d, s);
#if RAY_NORMALS
                facing = shape_normal(kind, p + d * at, s);
#endif
            }
            take(at, in_world(w.site_turn[own], facing), distance, normal);
        }
        const I hit = distance >= 0.0f;
        const V3 point = choose(hit, from + along * distance, nothing);
        if (RAY_NORMALS) normal = normal * (1.0f / VSQRT(VMAX(dot(normal, normal), splat(1e-30f))));
        T* to = w.sensed + ray_at[r];
        const int spec = ray_spec[r];
        if (spec & 1) *to++ = distance;
        const V3 rest[4] = {choose(hit, along, nothing), from, point, normal};
        for (int k = 0; k < 4; ++k)
            if (spec & 2 << k) to[0] = rest[k].x, to[1] = rest[k].y, to[2] = rest[k].z, to += 3;
        if (spec & 32) *to = distance;
    }
    SYNC
}
#endif
