// SPDX-License-Identifier: Apache-2.0
// Vectors of three numbers, and masks: what a comparison of numbers gives is all ones or nothing in every lane on a
// CPU, 1 or 0 on a GPU, so that masks are combined by &, | and VNOT alone.
#if !defined(__CUDA_ARCH__)
// Lanes of a mask as bits
INLINE unsigned bits(I m) {
#if LANES == 16 || LANES == 8
    typedef bool B __attribute__((ext_vector_type(LANES)));
#if LANES == 16
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(m, B));
#else
    return __builtin_bit_cast(unsigned char, __builtin_convertvector(m, B));
#endif
#else
    unsigned b = 0;
    for (int l = 0; l < LANES; ++l) b |= (m[l] < 0 ? 1u : 0u) << l;
    return b;
#endif
}
#endif
#if COOPERATE
// Sums and unions over the lanes of a warp that share one world, the same in all of them
INLINE T total(T x) {
    for (int m = 16; m; m >>= 1) x += __shfl_xor_sync(0xffffffffu, x, m);
    return x;
}
INLINE I some(I m) { return __any_sync(0xffffffffu, m); }
#else
INLINE T total(T x) { return x; }
INLINE I some(I m) { return m; }
#endif
INLINE T splat(float x) { return (T)x; }
INLINE T zero() { return (T)0.0f; }
struct V3 {
    T x, y, z;
    INNER V3 operator+(V3 b) const { return {x + b.x, y + b.y, z + b.z}; }
    INNER V3 operator-(V3 b) const { return {x - b.x, y - b.y, z - b.z}; }
    INNER V3 operator*(T s) const { return {x * s, y * s, z * s}; }
};
INLINE T dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE V3 cross(V3 a, V3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
INLINE V3 load(const T* p) { return {p[0], p[1], p[2]}; }
INLINE V3 vector(const float* p) { return {splat(p[0]), splat(p[1]), splat(p[2])}; }
// Rotation by rows of a quaternion (w, x, y, z)
INLINE void rows_of(const T* q, T* r) {
    const T w = q[0], x = q[1], y = q[2], z = q[3], s = 2.0f / (w * w + x * x + y * y + z * z);
    r[0] = 1.0f - s * (y * y + z * z), r[1] = s * (x * y - w * z), r[2] = s * (x * z + w * y);
    r[3] = s * (x * y + w * z), r[4] = 1.0f - s * (x * x + z * z), r[5] = s * (y * z - w * x);
    r[6] = s * (x * z - w * y), r[7] = s * (y * z + w * x), r[8] = 1.0f - s * (x * x + y * y);
}
// Quaternion (x, y, z, s) of a rotation by rows: from the largest of its four squares
INLINE void quaternion(const T* r, T& x, T& y, T& z, T& s) {
    const T squares[4] = {1.0f + r[0] + r[4] + r[8], 1.0f + r[0] - r[4] - r[8], 1.0f - r[0] + r[4] - r[8],
                          1.0f - r[0] - r[4] + r[8]};
    const T a = r[7] - r[5], b = r[2] - r[6], c = r[3] - r[1], d = r[1] + r[3], e = r[2] + r[6], f = r[5] + r[7];
    const T rows[4][4] = {{a, b, c, squares[0]}, {squares[1], d, e, a}, {d, squares[2], f, b}, {e, f, squares[3], c}};
    T most = squares[0];
    x = rows[0][0], y = rows[0][1], z = rows[0][2], s = rows[0][3];
    for (int k = 1; k < 4; ++k) {
        const I more = squares[k] > most;
        most = more ? squares[k] : most;
        x = more ? rows[k][0] : x, y = more ? rows[k][1] : y, z = more ? rows[k][2] : z, s = more ? rows[k][3] : s;
    }
    const T scale = 0.5f / VSQRT(most);
    x *= scale, y *= scale, z *= scale, s *= scale;
}
