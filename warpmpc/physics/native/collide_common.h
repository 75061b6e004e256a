// SPDX-License-Identifier: Apache-2.0
// What the collision functions share. They are static members of one struct; T, I, V3, World, put, tangent, gsize and the
// macros come before them.

// axis k of geom g
INLINE V3 axis_of(World& w, int g, int k) {
    const V3 r = {w.gmat[g][k], w.gmat[g][3 + k], w.gmat[g][6 + k]};
    return r;
}
// a where m, else b
INLINE V3 choose(I m, V3 a, V3 b) {
    const V3 r = {m ? a.x : b.x, m ? a.y : b.y, m ? a.z : b.z};
    return r;
}
INLINE T clip(T x, T limit) { return VMIN(VMAX(x, -limit), limit); }
// the vector d along the axes of r; a vector along these axes in the world
INLINE V3 along_axes(const T* r, V3 d) {
    const V3 o = {r[0] * d.x + r[3] * d.y + r[6] * d.z, r[1] * d.x + r[4] * d.y + r[7] * d.z, r[2] * d.x + r[5] * d.y + r[8] * d.z};
    return o;
}
INLINE V3 in_world(const T* r, V3 d) {
    const V3 o = {r[0] * d.x + r[1] * d.y + r[2] * d.z, r[3] * d.x + r[4] * d.y + r[5] * d.z, r[6] * d.x + r[7] * d.y + r[8] * d.z};
    return o;
}
#if HEIGHTS
// A height of a heightfield for every lane
INLINE T height_at(const World& w, int g, I at) {
    const float* heights = w.given + GIVEN_FIELD + field_first[g];
#if defined(__CUDA_ARCH__)
    return heights[at];
#else
    T out;
    for (int l = 0; l < LANES; ++l) ((float*)&out)[l] = heights[((const int*)&at)[l]];
    return out;
#endif
}
#endif
