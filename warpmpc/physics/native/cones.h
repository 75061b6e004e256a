// SPDX-License-Identifier: Apache-2.0
// What a contact costs with friction of any kind: along the tangents, about the normal, about the tangents, in a pyramid
// or an elliptic cone (MuJoCo, "Computation: Friction cones"). Takes the place of pyramid.h where a model needs it.

INLINE T pair_friction(const World& w, int pair, int k) {
    const int at = pair_friction_at[FRICTIONS * pair + k];
    return at >= 0 ? w.par[at] : splat(w.given[GIVEN_FRICTION + FRICTIONS * pair + k]);
}
#if ROWS > 3
// What a degree of freedom that turns so does about normal and tangents
INLINE void twist(V3 turn, V3 n, V3 t, T* r) {
    r[0] = dot(n, turn);
#if ROWS > 4
    r[1] = dot(t, turn);
    r[2] = dot(cross(n, t), turn);
#endif
}
#endif
// Entry i of Jᵀ f
INLINE T first_of(const Contact& c, const T* f, int i) {
    const T* r = c.jac + ROWS * i;
    T sum = r[0] * f[0];
    for (int k = 1; k < ROWS_OF(c); ++k) sum += r[k] * f[k];
    return sum;
}
// Of a row that only pushes
INLINE void slope_push(const Contact& c, T step, T& d1, T& d2, I& changed) {
    const T at = c.a[0] + step * c.s[0];
    const I on = at < 0.0f;
    const T u = on ? c.weight * c.s[0] : zero();
    d1 += at * u;
    d2 += u * c.s[0];
    changed |= (on ^ (c.a[0] < 0.0f)) & (c.weight > 0.0f);
}

#if ELLIPTIC
// With N = mu times the normal row's acceleration and U = friction times those of the other rows the cost is weight / 2
// times the squared distance of (N, U) from the cone N >= mu |U|: nothing within, to the tip where mu N <= -|U|, and to the
// side between. mu is the first friction over the root of impratio.
INLINE T slope_of(const Contact& c) { return c.friction[0] * CONE_SLOPE; }
INLINE void set_friction(const World& w, Contact& c, int pair, I lanes) {
    for (int k = 0; k < FRICTIONS; ++k) c.friction[k] = lanes ? pair_friction(w, pair, k) : c.friction[k];
    const T mu = slope_of(c);
    if (ROWS_OF(c) > 1) c.weight = lanes ? c.weight / (mu * mu) : c.weight;
}
INLINE void zone(T mu, T n, T t, I& side, I& tip) {
    const I outside = VNOT(n >= mu * t);
    tip = outside & (mu * n + t <= 0.0f);
    side = outside & VNOT(tip);
}
// What a contact adds to the derivatives of the cost along the search direction, and lanes whose cost is not one parabola
INLINE void slope_contact(const Contact& c, T step, T& d1, T& d2, I& changed) {
    if (ROWS_OF(c) == 1) return slope_push(c, step, d1, d2, changed);
    const T mu = slope_of(c), n0 = mu * c.a[0], v0 = mu * c.s[0], n = n0 + step * v0;
    T before = zero(), uu = before, uv = before, vv = before;
    for (int k = 1; k < ROWS_OF(c); ++k) {
        const T u0 = c.friction[k - 1] * c.a[k], v = c.friction[k - 1] * c.s[k], u = u0 + step * v;
        before += u0 * u0;
        uu += u * u;
        uv += u * v;
        vv += v * v;
    }
    I side0, tip0, side, tip;
    zone(mu, n0, VSQRT(before), side0, tip0);
    const T t = VSQRT(uu);
    zone(mu, n, t, side, tip);
    changed |= (side0 | side | (tip ^ tip0)) & (c.weight > 0.0f);
    const T over = 1.0f / VMAX(t, splat(1e-20f)), flat = c.weight / (1.0f + mu * mu);
    const T z = n - mu * t, along = uv * over, z1 = v0 - mu * along, z2 = -mu * (vv - along * along) * over;
    d1 += tip ? c.weight * (n * v0 + uv) : side ? flat * z * z1 : zero();
    d2 += tip ? c.weight * (v0 * v0 + vv) : side ? flat * (z1 * z1 + z * z2) : zero();
}
// What a contact costs at a length of the search direction
INLINE T cost_contact(const Contact& c, T step) {
    const T mu = slope_of(c), n0 = c.a[0] + step * c.s[0], n = mu * n0;
    if (ROWS_OF(c) == 1) return n0 < 0.0f ? 0.5f * c.weight * n0 * n0 : zero();
    T uu = zero();
    for (int k = 1; k < ROWS_OF(c); ++k) {
        const T u = c.friction[k - 1] * (c.a[k] + step * c.s[k]);
        uu += u * u;
    }
    I side, tip;
    const T t = VSQRT(uu), z = n - mu * t;
    zone(mu, n, t, side, tip);
    return 0.5f * c.weight * (tip ? n * n + uu : side ? z * z / (1.0f + mu * mu) : zero());
}
// Second derivatives (by rows: 00, 10, 11, 20, ...) and first ones of a contact's cost by its rows
INLINE void derive(const Contact& c, T* second, T* first) {
    const int rows = ROWS_OF(c);
    for (int k = rows; k < PUSH; ++k) first[k] = zero();
    if (rows == 1) {
        second[0] = c.a[0] < 0.0f ? c.weight : zero();
        first[0] = second[0] * c.a[0];
        return;
    }
    const T mu = slope_of(c), n = mu * c.a[0];
    T u[ROWS], uu = zero();
    for (int k = 1; k < rows; ++k) {
        u[k] = c.friction[k - 1] * c.a[k];
        uu += u[k] * u[k];
    }
    I side, tip;
    const T t = VSQRT(uu), over = 1.0f / VMAX(t, splat(1e-20f)), z = n - mu * t;
    zone(mu, n, t, side, tip);
    const T flat = c.weight / (1.0f + mu * mu), bent = -mu * z * over;
    // of N, then of U along itself and across
    const T whole = tip ? c.weight : zero(), by_n = side ? flat : whole, across = side ? flat * bent : whole;
    const T along = side ? flat * (mu * mu - bent) : zero(), mixed = side ? -flat * mu : zero();
    second[0] = mu * mu * by_n;
    first[0] = mu * (tip ? c.weight * n : side ? flat * z : zero());
    const T pull = tip ? c.weight : side ? flat * bent : zero();
    for (int i = 1; i < rows; ++i) {
        const T fi = c.friction[i - 1], ui = u[i] * over;
        T* row = second + i * (i + 1) / 2;
        row[0] = mu * fi * mixed * ui;
        for (int j = 1; j <= i; ++j) {
            const T both = along * ui * (u[j] * over);
            row[j] = fi * c.friction[j - 1] * (j == i ? both + across : both);
        }
        first[i] = fi * pull * u[i];
    }
}
// Row times second derivatives
INLINE void bend(const T* d, const T* r, int rows, T* b) {
    for (int i = 0; i < rows; ++i) {
        b[i] = zero();
        for (int j = 0; j <= i; ++j) b[i] += d[i * (i + 1) / 2 + j] * r[j];
        for (int j = i + 1; j < rows; ++j) b[i] += d[j * (j + 1) / 2 + i] * r[j];
    }
}
#else
INLINE void set_friction(const World& w, Contact& c, int pair, I lanes) {
    for (int k = 0; k < FRICTIONS; ++k) c.friction[k] = lanes ? pair_friction(w, pair, k) : c.friction[k];
}
// What a contact adds to the derivatives of the cost along the search direction, and lanes where an edge changes sides
INLINE void slope_contact(const Contact& c, T step, T& d1, T& d2, I& changed) {
    if (ROWS_OF(c) == 1) return slope_push(c, step, d1, d2, changed);
    T p1 = zero(), p2 = p1;
    for (int k = 1; k < ROWS_OF(c); ++k)
        for (int sign = -1; sign < 2; sign += 2) {
            const T mu = c.friction[k - 1] * (float)sign, a = c.a[0] + mu * c.a[k], s = c.s[0] + mu * c.s[k];
            const T at = a + step * s;
            const I on = at < 0.0f;
            const T u = on ? s : zero();
            p1 += at * u;
            p2 += u * s;
            changed |= (on ^ (a < 0.0f)) & (c.weight > 0.0f);
        }
    d1 += c.weight * p1;
    d2 += c.weight * p2;
}
// What a contact costs at a length of the search direction
INLINE T cost_contact(const Contact& c, T step) {
    const T n = c.a[0] + step * c.s[0], low = VMIN(n, zero());
    if (ROWS_OF(c) == 1) return 0.5f * c.weight * low * low;
    T sum = zero();
    for (int k = 1; k < ROWS_OF(c); ++k) {
        const T u = c.friction[k - 1] * (c.a[k] + step * c.s[k]), a = VMIN(n + u, zero()), b = VMIN(n - u, zero());
        sum += a * a + b * b;
    }
    return 0.5f * c.weight * sum;
}
// Second derivatives (00, 01, 02, ..., then 11, 22, ...) and first ones of a contact's cost by its rows
INLINE void derive(const Contact& c, T* second, T* first) {
    const int rows = ROWS_OF(c);
    for (int k = 1; k < PUSH; ++k) first[k] = zero();
    if (rows == 1) {
        second[0] = c.a[0] < 0.0f ? c.weight : zero();
        first[0] = second[0] * c.a[0];
        return;
    }
    second[0] = first[0] = zero();
    for (int k = 1; k < rows; ++k) {
        const T mu = c.friction[k - 1], x = mu * c.a[k], a = c.a[0] + x, b = c.a[0] - x;
        const T up = a < 0.0f ? c.weight : zero(), down = b < 0.0f ? c.weight : zero();
        second[0] += up + down;
        second[k] = mu * (up - down);
        second[rows - 1 + k] = mu * mu * (up + down);
        first[0] += up * a + down * b;
        first[k] = mu * (up * a - down * b);
    }
}
// Row times second derivatives
INLINE void bend(const T* d, const T* r, int rows, T* b) {
    b[0] = d[0] * r[0];
    for (int k = 1; k < rows; ++k) {
        b[0] += d[k] * r[k];
        b[k] = d[k] * r[0] + d[rows - 1 + k] * r[k];
    }
}
#endif
// Entry (i, j) of Jᵀ D J
INLINE T second_of(const Contact& c, const T* d, int i, int j) {
    const int rows = ROWS_OF(c);
    const T* o = c.jac + ROWS * j;
    T b[ROWS], sum = zero();
    bend(d, c.jac + ROWS * i, rows, b);
    for (int k = 0; k < rows; ++k) sum += b[k] * o[k];
    return sum;
}
#if !COOPERATE
INLINE void add_block(const int N, World& w, const Contact& c, const T* second, const T* first) {
    const int rows = ROWS_OF(c);
    for (int i = 0; i < N; ++i) {
        T b[ROWS];
        bend(second, c.jac + ROWS * i, rows, b);
        w.grad[group_dof[c.group * NNZ + i]] += first_of(c, first, i);
        const short* place = group_entry + c.group * NTRIANGLE + i * (i + 1) / 2;
        for (int j = 0; j <= i; ++j) {
            const T* o = c.jac + ROWS * j;
            T sum = b[0] * o[0];
            for (int k = 1; k < rows; ++k) sum += b[k] * o[k];
            w.h[place[j]] += sum;
        }
    }
}
#endif
