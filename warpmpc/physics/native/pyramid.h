// SPDX-License-Identifier: Apache-2.0
// What a contact costs with no friction, or with friction along its two tangents in a pyramid (MuJoCo, "Computation: Friction
// cones"); other kinds of friction are in cones.h, which takes the place of this file.

INLINE T pair_friction(const World& w, int pair) {
    const int at = pair_friction_at[pair];
    return at >= 0 ? w.par[at] : splat(w.given[GIVEN_FRICTION + pair]);
}
INLINE void set_friction(const World& w, Contact& c, int pair, I lanes) {
    c.friction[0] = lanes ? pair_friction(w, pair) : c.friction[0];
}
// The edges of a pyramid
INLINE void edges(T mu, const T* along, T* e) {
#if ROWS == 3
    const T x = mu * along[1], y = mu * along[2];
    e[0] = along[0] + x;
    e[1] = along[0] - x;
    e[2] = along[0] + y;
    e[3] = along[0] - y;
#endif
}
// What a contact adds to the derivatives of the cost along the search direction, and lanes where an edge changes sides
INLINE void slope_contact(const Contact& c, T step, T& d1, T& d2, I& changed) {
    if (!group_slides[c.group]) {
        const T at = c.a[0] + step * c.s[0];
        const I on = at < 0.0f;
        const T u = on ? c.weight * c.s[0] : zero();
        d1 += at * u;
        d2 += u * c.s[0];
        changed |= (on ^ (c.a[0] < 0.0f)) & (c.weight > 0.0f);
        return;
    }
    T a[4], s[4];
    edges(c.friction[0], c.a, a);
    edges(c.friction[0], c.s, s);
    T p1 = zero(), p2 = p1;
    for (int k = 0; k < 4; ++k) {
        const T at = a[k] + step * s[k];
        const I on = at < 0.0f;
        const T u = on ? s[k] : zero();
        p1 += at * u;
        p2 += u * s[k];
        changed |= (on ^ (a[k] < 0.0f)) & (c.weight > 0.0f);
    }
    d1 += c.weight * p1;
    d2 += c.weight * p2;
}
// What a contact costs at a length of the search direction
INLINE T cost_contact(const Contact& c, T step) {
    T a[4], s[4], sum = zero();
    const T n = VMIN(c.a[0] + step * c.s[0], zero());
    if (ROWS == 1 || !group_slides[c.group]) return 0.5f * c.weight * n * n;
    edges(c.friction[0], c.a, a);
    edges(c.friction[0], c.s, s);
    for (int k = 0; k < 4; ++k) {
        const T at = VMIN(a[k] + step * s[k], zero());
        sum += at * at;
    }
    return 0.5f * c.weight * sum;
}
// Second derivatives (00, 01, 02, 11, 22) and first ones of a contact's cost by its rows
INLINE void derive(const Contact& c, T* second, T* first) {
    if (ROWS == 1 || !group_slides[c.group]) {
        second[0] = c.a[0] < 0.0f ? c.weight : zero();
        second[1] = second[2] = second[3] = second[4] = first[1] = first[2] = zero();
        first[0] = second[0] * c.a[0];
        return;
    }
    const T mu = c.friction[0];
    T a[4], k[4];
    edges(mu, c.a, a);
    for (int u = 0; u < 4; ++u) k[u] = a[u] < 0.0f ? c.weight : zero();
    second[0] = k[0] + k[1] + k[2] + k[3];
    second[1] = mu * (k[0] - k[1]);
    second[2] = mu * (k[2] - k[3]);
    second[3] = mu * mu * (k[0] + k[1]);
    second[4] = mu * mu * (k[2] + k[3]);
    for (int u = 0; u < 4; ++u) k[u] *= a[u];
    first[0] = k[0] + k[1] + k[2] + k[3];
    first[1] = mu * (k[0] - k[1]);
    first[2] = mu * (k[2] - k[3]);
}
// Entry (i, j) of Jᵀ D J, and entry i of Jᵀ f
INLINE T second_of(const Contact& c, const T* d, int i, int j) {
    const T *r = c.jac + ROWS * i, *o = c.jac + ROWS * j;
#if ROWS == 3
    const T b0 = d[0] * r[0] + d[1] * r[1] + d[2] * r[2], b1 = d[1] * r[0] + d[3] * r[1], b2 = d[2] * r[0] + d[4] * r[2];
    return b0 * o[0] + b1 * o[1] + b2 * o[2];
#else
    return d[0] * r[0] * o[0];
#endif
}
INLINE T first_of(const Contact& c, const T* f, int i) {
    const T* r = c.jac + ROWS * i;
#if ROWS == 3
    return r[0] * f[0] + r[1] * f[1] + r[2] * f[2];
#else
    return r[0] * f[0];
#endif
}
#if !COOPERATE
// Jᵀ D J and Jᵀ f of a contact; four rows at once, so that what they have in common is read once
INLINE void add_block(const int N, World& w, const Contact& c, const T* d, const T* f) {
    const short* place = group_entry + c.group * NTRIANGLE;
    UNROLL for (int first = 0; first < N; first += 4) {
        T b[4][ROWS];
        UNROLL for (int i = first; i < N && i < first + 4; ++i) {
            const T* r = c.jac + ROWS * i;
            T* to = b[i - first];
#if ROWS == 3
            to[0] = d[0] * r[0] + d[1] * r[1] + d[2] * r[2];
            to[1] = d[1] * r[0] + d[3] * r[1];
            to[2] = d[2] * r[0] + d[4] * r[2];
#else
            to[0] = d[0] * r[0];
#endif
            w.grad[group_dof[c.group * NNZ + i]] += first_of(c, f, i);
        }
        UNROLL for (int j = 0; j < N && j < first + 4; ++j) {
            T o[ROWS];
            for (int k = 0; k < ROWS; ++k) o[k] = c.jac[ROWS * j + k];
            UNROLL for (int i = j < first ? first : j; i < N && i < first + 4; ++i) {
                T& h = w.h[place[i * (i + 1) / 2 + j]];
                T sum = h;
                for (int k = 0; k < ROWS; ++k) sum = FMA(b[i - first][k], o[k], sum);
                h = sum;
            }
        }
    }
}
#endif
