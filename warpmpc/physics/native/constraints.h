// SPDX-License-Identifier: Apache-2.0
// Rows whose degrees of freedom are known beforehand: friction of joints (dry), and constraints (equalities, limits
// of ball joints and tendons, friction of tendons). The derivative of a row's cost is its weight times its acceleration beyond
// the reference, within bounds: none for an equality, zero above for a limit, the loss on both sides for friction.

// A row of some lanes: what is to vanish, what its impedance depends on, its velocity, and its acceleration while no
// joint accelerates
#if CONSTRAINTS
INLINE void constraint(World& w, int k, T distance, T measure, T rate, T curving, I on) {
    const T imp = impedance(constraint_impedance + SOFT * k, measure);
    const int at = constraint_inverse_at[k];
    const T inverse = at >= 0 ? w.par[at] : splat(w.given[GIVEN_CONSTRAINT_INVERSE + k]);
    w.constraint_weight[k] = on ? row_weight(inverse, imp, w.given[GIVEN_CONSTRAINT_FLOOR + k]) : zero();
    w.constraint_ref[k] = on ? -constraint_damping[k] * rate - constraint_stiffness[k] * imp * distance - curving : zero();
    w.constraint_s[k] = zero();
}
BIND
#endif
INLINE T between(T x, float low, float high) { return VMIN(VMAX(x, splat(low)), splat(high)); }
// Derivatives of one row's cost along the search direction, added up
INLINE void slope_of(T weight, T a, T s, T step, float low, float high, T& d1, T& d2, I& changed) {
    const T x = weight * (a + step * s), was = weight * a;
    const I over = x > low, under = x < high;
    d1 += between(x, low, high) * s;
    d2 += (over & under) ? weight * s * s : zero();
    changed |= (over ^ (was > low)) | (under ^ (was < high));
}
#if DRY
// Friction of joints
FN void dry(World& w) {
    EACH(k, DRY) {
        const int at = dry_inverse_at[k];
        const T inverse = at >= 0 ? w.par[at] : splat(w.given[GIVEN_DRY_INVERSE + k]);
        w.dry_weight[k] = row_weight(inverse, splat(dry_impedance[k]), 1e-15f);
        w.dry_ref[k] = -dry_damping[k] * w.v[dry_dof[k]];
        w.dry_s[k] = zero();
    }
}
#endif
// Rows that are always there: whether they couple branches of the trees in live lanes
INLINE bool ties_couple(const World& w, unsigned live) {
    bool out = false;
#if CONSTRAINTS
    for (int k = 0; k < CONSTRAINTS; ++k) out |= constraint_couples[k] && (VBITS(w.constraint_weight[k] > 0.0f) & live);
#endif
    return out;
}
// Lanes that none of these rows constrains
INLINE I untied(const World& w) {
    I out = DRY ? NO : YES;
#if CONSTRAINTS
    for (int k = 0; k < CONSTRAINTS; ++k) out &= VNOT(w.constraint_weight[k] > 0.0f);
#endif
    return out;
}
#if CONSTRAINTS
INLINE void project_ties(World& w, const T* x, T* to) {
    EACH(k, CONSTRAINTS) {
        T sum = zero();
        for (int n = 0; n < constraint_count[k]; ++n) sum += w.constraint_jac[k][n] * x[constraint_dof[k * CONSTRAINT_DOFS + n]];
        to[k] = sum;
    }
}
#endif
// Accelerations beyond the references
INLINE void start_ties(World& w) {
#if CONSTRAINTS
    project_ties(w, w.x, w.constraint_a);
    EACH(k, CONSTRAINTS) w.constraint_a[k] -= w.constraint_ref[k];
#endif
#if DRY
    EACH(k, DRY) w.dry_a[k] = w.x[dry_dof[k]] - w.dry_ref[k];
#endif
}
INLINE void search_ties(World& w) {
#if CONSTRAINTS
    project_ties(w, w.search, w.constraint_s);
#endif
#if DRY
    EACH(k, DRY) w.dry_s[k] = w.search[dry_dof[k]];
#endif
}
INLINE void step_ties(World& w, T step) {
#if CONSTRAINTS
    EACH(k, CONSTRAINTS) w.constraint_a[k] += step * w.constraint_s[k];
#endif
#if DRY
    EACH(k, DRY) w.dry_a[k] += step * w.dry_s[k];
#endif
}
INLINE void slope_ties(const World& w, T step, T& d1, T& d2, I& changed) {
#if CONSTRAINTS
    EACH(k, CONSTRAINTS) slope_of(w.constraint_weight[k], w.constraint_a[k], w.constraint_s[k], step, constraint_low[k], constraint_high[k], d1, d2, changed);
#endif
#if DRY
    EACH(k, DRY) slope_of(w.dry_weight[k], w.dry_a[k], w.dry_s[k], step, -dry_force[k], dry_force[k], d1, d2, changed);
#endif
}
// What the rows add to the Hessian, unless there is none, and to the gradient (sign 1) or the forces (-1)
INLINE void add_ties(World& w, T* h, T* to, float sign) {
#if DRY
    EACH(k, DRY) {
        const int i = dry_dof[k];
        const T x = w.dry_weight[k] * w.dry_a[k];
        to[i] += sign * between(x, -dry_force[k], dry_force[k]);
        if (h) h[i * (i + 1) / 2 + i] += ((x > -dry_force[k]) & (x < dry_force[k])) ? w.dry_weight[k] : zero();
    }
    SYNC
#endif
#if CONSTRAINTS
    for (int k = 0; k < CONSTRAINTS; ++k) {
        const T x = w.constraint_weight[k] * w.constraint_a[k];
        const T push = sign * between(x, constraint_low[k], constraint_high[k]);
        const T bend = ((x > constraint_low[k]) & (x < constraint_high[k])) ? w.constraint_weight[k] : zero();
        const int count = constraint_count[k];
        const T* j = w.constraint_jac[k];
        EACH(n, count) {
            to[constraint_dof[k * CONSTRAINT_DOFS + n]] += push * j[n];
            if (h) for (int o = 0; o <= n; ++o) h[constraint_entry[k * (CONSTRAINT_DOFS * (CONSTRAINT_DOFS + 1) / 2) + n * (n + 1) / 2 + o]] += bend * j[n] * j[o];
        }
        SYNC
    }
#endif
}
