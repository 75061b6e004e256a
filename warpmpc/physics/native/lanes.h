// SPDX-License-Identifier: Apache-2.0
// Products and solves that the lanes of a warp divide among themselves; matrices are packed by rows, with all entries.
#if !COOPERATE && LOOPED
// x = sign H⁻¹ g by H = Lᵀ L as in factor.py, in loops where it would be too much to write out; L takes the place of H.
// What trees that do not touch one another leave zero in all lanes is passed over.
FN void solve_coupled(T* h, const T* g, T* x, float sign) {
    for (int i = 0; i < NV; ++i) x[i] = sign * g[i];
    for (int k = NV - 1; k >= 0; --k) {
        T* const row = h + k * (k + 1) / 2;
        const short *column = coupled_column + coupled_first[k], *const end = coupled_column + coupled_first[k + 1];
        row[k] = 1.0f / VSQRT(row[k]);
        x[k] *= row[k];
        for (const short* c = column; c < end; ++c) row[*c] *= row[k];
        for (; column < end; ++column) {
            const int i = *column;
            const T factor = row[i];
            if (!VANY(factor != 0.0f)) continue;
            T* const to = h + i * (i + 1) / 2;
            x[i] = FMA(-factor, x[k], x[i]);
            for (const short* c = column; c < end; ++c) to[*c] = FMA(-factor, row[*c], to[*c]);
        }
    }
    for (int k = 0; k < NV; ++k) {
        const T* const row = h + k * (k + 1) / 2;
        for (int n = coupled_first[k + 1] - 1; n >= coupled_first[k]; --n)
            x[k] = FMA(-row[coupled_column[n]], x[coupled_column[n]], x[k]);
        x[k] *= row[k];
    }
}
#endif
#if COOPERATE
FN void multiply(const T* m, const T* x, T* y) {
    EACH(i, NV) {
        T sum = zero();
        for (int j = 0; j < NV; ++j) sum += m[j <= i ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i] * x[j];
        y[i] = sum;
    }
}
#if NV <= 31
// x = sign H⁻¹ g by Gauss-Jordan elimination: a lane has a row and its right-hand side in registers
FN void solve_lanes(const T* h, const T* g, T* x, float sign) {
    const int lane = threadIdx.x & 31, i = lane < NV ? lane : 0;
    T row[NV], right = sign * g[i];
#pragma unroll
    for (int j = 0; j < NV; ++j) row[j] = h[j <= i ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i];
#pragma unroll
    for (int k = 0; k < NV; ++k) {
        const T pivot = __shfl_sync(0xffffffffu, row[k], k), factor = lane == k ? 0.0f : row[k] / pivot;
#pragma unroll
        for (int j = k + 1; j < NV; ++j) row[j] -= factor * __shfl_sync(0xffffffffu, row[j], k);
        right -= factor * __shfl_sync(0xffffffffu, right, k);
    }
    T own = row[0];
#pragma unroll
    for (int k = 1; k < NV; ++k) own = lane == k ? row[k] : own;
    if (lane < NV) x[lane] = right / own;
    SYNC
}
#else
// x = sign H⁻¹ g; Cholesky's factor takes the place of H but for its diagonal, which holds the squares. A lane has a row,
// and the right-hand side is the last one: what is left of it after the factorization only has to go back.
FN void solve_lanes(T* h, const T* g, T* x, float sign) {
    const int lane = threadIdx.x & 31;
    EACH(i, NV) x[i] = sign * g[i];
    SYNC
    for (int k = 0; k < NV; ++k) {
        const T* pivot = h + k * (k + 1) / 2;
        for (int i = k + lane; i <= NV; i += 32) {
            T* row = i < NV ? h + i * (i + 1) / 2 : x;
            T sum = row[k];
#pragma unroll 4
            for (int j = 0; j < k; ++j) sum -= row[j] * pivot[j];
            row[k] = sum;
        }
        SYNC
        const T inverse = 1.0f / VSQRT(pivot[k]);
        for (int i = k + lane; i <= NV; i += 32)
            if (i > k) (i < NV ? h + i * (i + 1) / 2 : x)[k] *= inverse;
        SYNC
    }
    T left[(NV + 31) / 32], inverse[(NV + 31) / 32];
#pragma unroll
    for (int r = 0; r < (NV + 31) / 32; ++r) {
        const int i = lane + 32 * r;
        left[r] = i < NV ? x[i] : 0.0f;
        inverse[r] = i < NV ? 1.0f / VSQRT(h[i * (i + 1) / 2 + i]) : 0.0f;
    }
#pragma unroll
    for (int r = (NV + 31) / 32 - 1; r >= 0; --r)
        for (int k = NV - 1 < 32 * r + 31 ? NV - 1 : 32 * r + 31; k >= 32 * r; --k) {
            const T solved = __shfl_sync(0xffffffffu, left[r] * inverse[r], k & 31);
#pragma unroll
            for (int o = 0; o <= r; ++o) {
                const int i = lane + 32 * o;
                if (i < k) left[o] -= h[k * (k + 1) / 2 + i] * solved;
                if (i == k) left[o] = solved;
            }
        }
#pragma unroll
    for (int r = 0; r < (NV + 31) / 32; ++r)
        if (lane + 32 * r < NV) x[lane + 32 * r] = left[r];
    SYNC
}
#endif
#endif
