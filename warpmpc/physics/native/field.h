// SPDX-License-Identifier: Apache-2.0
// A heightfield against any convex shape: two prisms for each cell of its grid under the shape's box, each of which may have
// one contact (MuJoCo, "XML reference: hfield"). Each lane goes through its own cells. After collide_convex.h.

// How far a shape reaches from its centre along an axis of the field
INLINE T reach(const Shapes& s, V3 d) {
    return dot(along_axes(s.r, d), farthest(s.kind2, s.g2, s.s2, along_axes(s.r, d))) + s.round2;
}
FN void field(World& w, int pair, int g1, int g2, int kind2, I near) {
    Shapes s;
    shapes_of(w, g1, g2, PRISM, kind2, s);
    const T zero = splat(0.0f), one = splat(1.0f), margin = splat(pair_margin[pair]);
    const V3 p = s.p, x = {one, zero, zero}, y = {zero, one, zero}, down = {zero, zero, -one};
    const float *size = field_size + 4 * g1;  // half lengths, height and depth
    const int columns = field_columns[g1], rows = field_rows[g1];
    const float dx = 2.0f * size[0] / (columns - 1), dy = 2.0f * size[1] / (rows - 1);
    const T left = p.x - reach(s, x * -one) - margin, right = p.x + reach(s, x) + margin;
    const T front = p.y - reach(s, y * -one) - margin, back = p.y + reach(s, y) + margin;
    const T low = p.z - reach(s, down) - margin;
    near = near & (right > -size[0]) & (left < size[0]) & (back > -size[1]) & (front < size[1]) & (low < size[2]);
    if (!VANY(near)) return;
    const T last_column = splat((float)(columns - 2)), last_row = splat((float)(rows - 2));
    const I c0 = VINT(VMIN(VMAX((left + size[0]) * (1.0f / dx), zero), last_column));
    const I c1 = VINT(VMIN(VMAX((right + size[0]) * (1.0f / dx), zero), last_column));
    const I r1 = VINT(VMIN(VMAX((back + size[1]) * (1.0f / dy), zero), last_row));
    I c = c0, r = VINT(VMIN(VMAX((front + size[1]) * (1.0f / dy), zero), last_row));
    s.s1 = V3{splat(dx < dy ? dx : dy), zero, zero};
    const V3 base = load(w.gpos[g1]);
    while (VANY(near & (r <= r1))) {
        const I on = near & (r <= r1), row = r <= r1 ? r : r1, at = row * (I)columns + c;
        const T h00 = height_at(w, g1, at), h01 = height_at(w, g1, at + (I)1);
        const T h10 = height_at(w, g1, at + (I)columns), h11 = height_at(w, g1, at + (I)(columns + 1));
        const T left_x = VFLOAT(c) * dx - size[0], front_y = VFLOAT(row) * dy - size[1];
        for (int half = 0; half < 2; ++half) {  // the corner beside the diagonal is behind, then right
            const T side = half ? h01 : h10;
            const I m = on & (VMAX(VMAX(h00, h11), side) >= low);
            if (!VANY(m)) continue;
            const V3 o = {left_x + 0.5f * dx, front_y + 0.5f * dy, 0.5f * (VMIN(VMIN(h00, h11), side) - size[3])};
            const T bottom = -size[3] - o.z, w2 = splat(0.5f * dx), d2 = splat(0.5f * dy);
            s.corner[0] = V3{zero - w2, zero - d2, h00 - o.z};
            s.corner[1] = V3{w2, d2, h11 - o.z};
            s.corner[2] = V3{half ? w2 : zero - w2, half ? zero - d2 : d2, side - o.z};
            for (int k = 0; k < 3; ++k) s.corner[3 + k] = V3{s.corner[k].x, s.corner[k].y, bottom};
            s.p = p - o;
            s.origin = base + in_world(w.gmat[g1], o);
            meet(w, pair, s, m);
        }
        c = c + (I)1;
        const I over = c > c1;
        c = over ? c0 : c;
        r = over ? r + (I)1 : r;
    }
}
FN void hfield_sphere(World& w, int pair, int g1, int g2, I near) { field(w, pair, g1, g2, SPHERE, near); }
FN void hfield_capsule(World& w, int pair, int g1, int g2, I near) { field(w, pair, g1, g2, CAPSULE, near); }
FN void hfield_ellipsoid(World& w, int pair, int g1, int g2, I near) { field(w, pair, g1, g2, ELLIPSOID, near); }
FN void hfield_cylinder(World& w, int pair, int g1, int g2, I near) { field(w, pair, g1, g2, CYLINDER, near); }
FN void hfield_box(World& w, int pair, int g1, int g2, I near) { field(w, pair, g1, g2, BOX, near); }
#if MESHES
FN void hfield_mesh(World& w, int pair, int g1, int g2, I near) { field(w, pair, g1, g2, MESH, near); }
#endif
