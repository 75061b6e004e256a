// SPDX-License-Identifier: Apache-2.0
// Contacts become rows of constraints (MuJoCo, "Computation: Constraint model").

// First tangent of a contact whose kind does not set one
INLINE V3 tangent(V3 n) {
    const I up = VABS(n.y) >= 0.5f;
    const V3 along = choose(up, {zero(), zero(), splat(1.0f)}, {zero(), splat(1.0f), zero()});
    const V3 t = along - n * dot(n, along);
    return t * (1.0f / VSQRT(dot(t, t)));
}
// Impedance at a distance: least, most, width, midpoint; power 2, or power and the factors of both pieces
INLINE T impedance(const float* p, T distance) {
    const T x = VMIN(VABS(distance) * (1.0f / p[2]), splat(1.0f));
#if SOFT == 7
    T rise = x, fall = 1.0f - x;
    for (int k = 1; k < (int)p[4]; ++k) rise *= x, fall *= 1.0f - x;
    return p[0] + (x > p[3] ? 1.0f - p[6] * fall : p[5] * rise) * (p[1] - p[0]);
#endif
    const T o = 1.0f - x, low = x * x * (1.0f / p[3]), high = 1.0f - o * o * (1.0f / (1.0f - p[3]));
    return p[0] + (x > p[3] ? high : low) * (p[1] - p[0]);
}
// One over the regularization of a row, which is never below a floor that single precision needs
INLINE T row_weight(T inverse, T imp, float floor) { return 1.0f / VMAX(inverse * (1.0f - imp) / imp, splat(floor)); }
INLINE T pair_inverse(const World& w, int pair) {
    const int at = pair_inverse_at[pair];
    return at >= 0 ? w.par[at] : splat(w.given[GIVEN_PAIR_INVERSE + pair]);
}

// Entry k of a contact's rows: what its degree of freedom does along normal and tangents
INLINE void entry(const World& w, int pair, int g, int k, V3 p, V3 n, V3 t, T* r) {
    const float sign = pair_sign[pair * NNZ + k];
    const int i = group_dof[g * NNZ + k];
    const V3 d = (load(w.cl[i]) + cross(load(w.cw[i]), p - load(w.ref[dof_top[i]]))) * splat(sign);
    r[0] = dot(n, d);
#if ROWS >= 3
    const bool slides = group_slides[g];
    r[1] = slides ? dot(t, d) : zero();
    r[2] = slides ? dot(cross(n, t), d) : zero();
#endif
#if ROWS > 3
    twist(load(w.cw[i]) * splat(sign), n, t, r + 3);
#endif
}
// What a contact of some lanes costs and refers to, from the velocities along its rows
INLINE void soften(World& w, Contact& c, int pair, I lanes, T distance, const T* v) {
    const T beyond = distance - pair_margin[pair];
    const T imp = impedance(pair_impedance + SOFT * pair, beyond);
    const float k = pair_stiffness[pair], damping = pair_damping[pair], slip = SLIP_DAMPING[pair];
    c.weight = lanes ? row_weight(pair_inverse(w, pair), imp, w.given[GIVEN_PAIR_FLOOR + pair]) : c.weight;
    set_friction(w, c, pair, lanes);
    for (int i = 0; i < ROWS; ++i) {
        const T ref = -(i ? slip : damping) * v[i] - (i ? zero() : k * imp * beyond);
        c.ref[i] = lanes ? ref : c.ref[i];
    }
}
#if TOLD
INLINE void direct(Contact& c, int pair, I lanes, T distance, V3 p, V3 n, V3 t) {
    const T* from[3] = {&n.x, &t.x, &p.x};
    for (int i = 0; i < 3; ++i) {
        c.normal[i] = lanes ? from[0][i] : c.normal[i];
        c.tangent[i] = lanes ? from[1][i] : c.tangent[i];
#if SENSES_CONTACTS
        c.point[i] = lanes ? from[2][i] : c.point[i];
#endif
    }
#if SENSES_CONTACTS
    c.distance = lanes ? distance : c.distance;
#endif
    c.pair = lanes ? (I)pair : c.pair;
}
#endif

// Rows of all contacts that live lanes have, times a vector over all degrees of freedom, into one of their fields
FN void project(World& w, unsigned live, const T* x, T (Contact::*to)[ROWS]) {
#if COOPERATE
    EACH(e, ROWS * w.contacts) {
        Contact& c = w.con[e / ROWS];
        const int* dof = group_dof + c.group * NNZ;
        const T* row = c.jac + e % ROWS;
        T sum = zero();
        for (int k = 0; k < c.count; ++k) sum += row[ROWS * k] * x[dof[k]];
        (c.*to)[e % ROWS] = sum;
    }
#else
    for (int n = 0; n < w.contacts; ++n) {
        Contact& c = w.con[n];
        if (!(c.used & live)) continue;
        const int* dof = group_dof + c.group * NNZ;
        T sum[ROWS];
        for (int i = 0; i < ROWS; ++i) sum[i] = zero();
        for (int k = 0; k < c.count; ++k) {
            const T b = x[dof[k]];
            for (int i = 0; i < ROWS; ++i) sum[i] += c.jac[ROWS * k + i] * b;
        }
        for (int i = 0; i < ROWS; ++i) (c.*to)[i] = sum[i];
    }
#endif
}
#if COOPERATE
// A contact that one lane has found: kept until all have looked
FN void put(World& w, int pair, I here, T distance, V3 p, V3 n, V3 t) {
    if (!here) return;
    const int at = atomicAdd(&w.found, 1);
    if (at >= CAPACITY) { w.overflow = 1; return; }
    Raw& r = w.raw[at];
    r.distance = distance;
    r.point = p;
    r.normal = n;
    r.tangent = t;
    r.pair = pair;
    r.key = pair_group[pair] * PAIRS + pair;
}
// What all lanes have found, by group and in the order of the pairs: a pair is one lane's, so that its own contacts
// are in order
FN void gather(World& w) {
    SYNC
    const int n = w.found < CAPACITY ? w.found : CAPACITY;
    EACH(k, n) {
        const int key = w.raw[k].key, group = pair_group[w.raw[k].pair];
        int rank = 0;
#pragma unroll 1
        for (int o = 0; o < n; ++o) rank += w.raw[o].key < key || (w.raw[o].key == key && o < k);
        w.con[rank].raw = k;
        w.con[rank].group = group;
        w.con[rank].count = group_count[group];
        w.con[rank].used = 1;
        w.order[k] = k;
    }
    w.contacts = n;
    SYNC
    EACH(e, n * NNZ) {
        Contact& c = w.con[e / NNZ];
        const int k = e % NNZ;
        if (k >= c.count) continue;
        const Raw& r = w.raw[c.raw];
        entry(w, r.pair, c.group, k, r.point, r.normal, r.tangent, c.jac + ROWS * k);
    }
    SYNC
    project(w, ~0u, w.v, &Contact::a);
    SYNC
    EACH(k, n) {
        Contact& c = w.con[k];
        const Raw& r = w.raw[c.raw];
        for (int i = 0; i < ROWS; ++i) c.s[i] = zero();
        soften(w, c, r.pair, YES, r.distance, c.a);
#if TOLD
        direct(c, r.pair, YES, r.distance, r.point, r.normal, r.tangent);
#endif
    }
    SYNC
}
#else
INLINE void empty(Contact& c, int group) {
    c.group = group;
    c.count = group_count[group];
    c.used = 0;
    c.weight = zero();
    for (int k = 0; k < FRICTIONS; ++k) c.friction[k] = zero();
    for (int k = 0; k < ROWS * c.count; ++k) c.jac[k] = zero();
    for (int i = 0; i < ROWS; ++i) c.ref[i] = c.s[i] = zero();
}
// The rows of a contact of some lanes
INLINE void fill(World& w, Contact& c, int pair, I lanes, T distance, V3 p, V3 n, V3 t) {
    T v[ROWS];
    for (int i = 0; i < ROWS; ++i) v[i] = zero();
    for (int k = 0; k < c.count; ++k) {
        if (pair_sign[pair * NNZ + k] == 0.0f) continue;
        const T vi = w.v[group_dof[c.group * NNZ + k]];
        T r[ROWS], *j = c.jac + ROWS * k;
        entry(w, pair, c.group, k, p, n, t, r);
        for (int i = 0; i < ROWS; ++i) {
            v[i] += r[i] * vi;
            j[i] = lanes ? r[i] : j[i];
        }
    }
    soften(w, c, pair, lanes, distance, v);
#if TOLD
    direct(c, pair, lanes, distance, p, n, t);
#endif
}
// A contact of some lanes: into the first one of its group after which these lanes have no other, so that every lane
// keeps its contacts in the order they came in, whatever its neighbours touch
FN void put(World& w, int pair, I lanes, T distance, V3 p, V3 n, V3 t) {
    const unsigned b = VBITS(lanes);
    const int g = pair_group[pair];
    int at = w.contacts;
    while (at > 0 && !(w.con[at - 1].group == g && (w.con[at - 1].used & b))) --at;
    while (at < w.contacts && w.con[at].group != g) ++at;
    if (at == w.contacts) {
        if (at == CAPACITY) { w.overflow |= b; return; }
        ++w.contacts;
        empty(w.con[at], g);
    }
    w.con[at].used |= b;
    fill(w, w.con[at], pair, lanes, distance, p, n, t);
}
// By group, and within it as they came: an order that other lanes do not change
INLINE void gather(World& w) {
    for (int k = 0; k < w.contacts; ++k) {
        int at = k;
        for (; at > 0 && w.con[w.order[at - 1]].group > w.con[k].group; --at) w.order[at] = w.order[at - 1];
        w.order[at] = k;
    }
}
#endif

// Limits of slides and hinges
FN void limit(World& w) {
    w.limits = COOPERATE ? LIMITS : 0;
    EACH(k, LIMITS) {
        const int i = limit_dof[k];
        const T q = w.q[limit_q[k]], low = q - limit_range[2 * k], high = limit_range[2 * k + 1] - q;
        const T distance = VMIN(low, high);
        const I m = distance < limit_margin[k];
        if (!COOPERATE && !VANY(m)) continue;
        const T side = m ? (high < low ? splat(-1.0f) : splat(1.0f)) : zero(), beyond = distance - limit_margin[k];
        const T imp = impedance(limit_impedance + SOFT * k, beyond);
        const int at = limit_inverse_at[k], n = COOPERATE ? k : w.limits++;
        const T inverse = at >= 0 ? w.par[at] : splat(w.given[GIVEN_LIMIT_INVERSE + k]);
        w.ldof[n] = i;
        w.lside[n] = side;
        w.lweight[n] = m ? row_weight(inverse, imp, 1e-15f) : zero();
        w.lref[n] = m ? -limit_damping[k] * side * w.v[i] - limit_stiffness[k] * imp * beyond : zero();
        w.ls[n] = zero();
    }
    SYNC
}
