// SPDX-License-Identifier: Apache-2.0
// The constraint solver: primal Newton with exact line search (MuJoCo, "Computation: Solver algorithms"), until every
// lane has converged. A lane that has does not change any more, whatever the others do.

// Derivatives of the cost along the search direction, and lanes where an inequality has changed sides
FN void slope(World& w, unsigned live, T step, T& slope1, T& slope2, I& sides) {
    T d1 = zero(), d2 = d1;
    I changed = NO;
    EACH(n, w.contacts) {
        const Contact& c = w.con[w.order[n]];
        if (!(c.used & live)) continue;
        slope_contact(c, step, d1, d2, changed);
    }
    EACH(k, w.limits) {
        const T at = w.la[k] + step * w.ls[k];
        const I on = at < 0.0f;
        const T u = on ? w.lweight[k] * w.ls[k] : zero();
        d1 += at * u;
        d2 += u * w.ls[k];
        changed |= (on ^ (w.la[k] < 0.0f)) & (w.lweight[k] > 0.0f);
    }
    slope_ties(w, step, d1, d2, changed);
    slope1 += total(d1);
    slope2 += total(d2);
    sides |= some(changed);
}
#if COOPERATE
// What contacts add to a matrix, unless there is none, and to a vector: lanes take entries, and neighbours in the list
// of one group share them
FN void add_contacts(World& w, T* h, T* to) {
    for (int n = 0; n < w.contacts;) {
        const int g = w.con[n].group, first = n, count = group_count[g], size = count * (count + 1) / 2;
        while (n < w.contacts && w.con[n].group == g) ++n;
        EACH(e, size + count) {
            T sum = zero();
            if (e >= size) {
#pragma unroll 1
                for (int m = first; m < n; ++m) sum += first_of(w.con[m], w.con[m].push, e - size);
                to[group_dof[g * NNZ + e - size]] += sum;
            } else if (h) {
                const int i = triangle_row[e], j = e - i * (i + 1) / 2;
#pragma unroll 1
                for (int m = first; m < n; ++m)
                    if (w.con[m].curve[0] > 0.0f) sum += second_of(w.con[m], w.con[m].curve, i, j);
                h[group_entry[g * NTRIANGLE + e]] += sum;
            }
        }
        SYNC
    }
}
#endif
// Hessian and gradient of the cost
FN void hessian(World& w, unsigned live) {
#if COOPERATE
    EACH(i, NH) w.h[i] = w.mm[i];
#else
    copy_tree(w.mm, w.h);
#endif
    EACH(i, NV) w.grad[i] = w.ma[i];
#if COOPERATE
    EACH(n, w.contacts) derive(w.con[n], w.con[n].curve, w.con[n].push);
    SYNC
    add_contacts(w, w.h, w.grad);
#else
    for (int n = 0; n < w.contacts; ++n) {
        const Contact& c = w.con[w.order[n]];
        if (!(c.used & live)) continue;
        T second[CURVE], first[PUSH];
        derive(c, second, first);
        if (!(VBITS(second[0] > 0.0f) & live)) continue;
        switch (c.count) {
#define BLOCK(N) case N: add_block(N, w, c, second, first); break;
            BLOCKS
#undef BLOCK
        }
    }
#endif
    EACH(k, w.limits) {
        const T u = w.la[k] < 0.0f ? w.lweight[k] : zero();
        const int i = w.ldof[k];
        w.grad[i] += w.lside[k] * u * w.la[k];
        w.h[i * (i + 1) / 2 + i] += u;
    }
    SYNC
    add_ties(w, w.h, w.grad, 1.0f);
}
// Accelerations without constraints, into w.search
INLINE void free_accelerations(World& w) {
#if COOPERATE
    EACH(i, NH) w.h[i] = w.mm[i];
    SYNC
    solve_lanes(w.h, w.fs, w.search, 1.0f);
#else
    solve_tree(w.mm, w.fs, w.search, 1.0f);
#endif
}
// The step of Newton's method
INLINE void descend(World& w, unsigned live) {
#if COOPERATE
    hessian(w, live);
    solve_lanes(w.h, w.grad, w.search, -1.0f);
#else
    bool coupled = ties_couple(w, live);
    for (int n = 0; n < w.contacts; ++n) coupled |= (w.con[n].used & live) && group_couples[w.con[n].group];
    if (coupled) for (int i = 0; i < NH; ++i) w.h[i] = zero();
    hessian(w, live);
    if (coupled) solve_coupled(w.h, w.grad, w.search, -1.0f);
    else solve_tree(w.h, w.grad, w.search, -1.0f);
#endif
}
// Rows' accelerations beyond the references
INLINE void project_accelerations(World& w) {
    project(w, ~0u, w.x, &Contact::a);
    SYNC
    EACH(n, w.contacts)
        for (int i = 0; i < ROWS; ++i) w.con[n].a[i] -= w.con[n].ref[i];
    EACH(k, w.limits) w.la[k] = w.lside[k] * w.x[w.ldof[k]] - w.lref[k];
    start_ties(w);
    SYNC
}
#if !FEW
// Accelerations x that minimize the cost; done: lanes that nothing constrains
FN void newton(World& w, I done) {
    multiply(w.mm, w.x, w.ma);
    SYNC
    EACH(i, NV) w.ma[i] -= w.fs[i];
    project_accelerations(w);
    for (int iteration = 0; iteration < ITERATIONS; ++iteration) {
        const unsigned live = VBITS(VNOT(done));
        descend(w, live);
        multiply(w.mm, w.search, w.mv);
        T q1 = zero(), q2 = q1, decrement = q1;
        EACH(i, NV) {
            q1 += w.search[i] * w.ma[i];
            q2 += w.search[i] * w.mv[i];
            decrement -= w.search[i] * w.grad[i];
        }
        q1 = total(q1);
        q2 = total(q2);
        decrement = total(decrement);
        done |= VNOT(decrement == decrement);  // what is not a number stays so
        const I last = (decrement < w.given[GIVEN_TOLERANCE]) & VNOT(done);
        T step = splat(1.0f), low = zero(), high = splat(1e9f);
        I active = VNOT(done | last), exact = last;
        if (VANY(active | last)) {
            project(w, live, w.search, &Contact::s);
            EACH(k, w.limits) w.ls[k] = w.lside[k] * w.search[w.ldof[k]];
            search_ties(w);
            SYNC
        }
        for (int tries = 0; tries < LINE_SEARCH && VANY(active); ++tries) {
            T d1 = q1 + step * q2, d2 = q2;
            I changed = NO;
            slope(w, live, step, d1, d2, changed);
            if (!tries)  // a whole step within one piece of the cost: its minimum
                exact |= (VABS(d1) < LINE_TOLERANCE * decrement) & VNOT(changed) & active;
            active &= VNOT(VABS(d1) < ROUGHLY * decrement);
            low = (active & (d1 < 0.0f)) ? step : low;
            high = (active & (d1 >= 0.0f)) ? step : high;
            T next = step - d1 / d2;
            next = ((next <= low) | (next >= high)) ? 0.5f * (low + VMIN(high, 2.0f * low + 1.0f)) : next;
            step = active ? next : step;
        }
        step = active ? low : step;  // lanes that have not finished keep the end that is surely downhill
        EACH(i, NV) {
            w.x[i] = done ? w.x[i] : w.x[i] + step * w.search[i];
            w.ma[i] = done ? w.ma[i] : w.ma[i] + step * w.mv[i];
        }
        step = done ? zero() : step;
        EACH(n, w.contacts) {
            Contact& c = w.con[n];
            if (!(c.used & live)) continue;
            for (int i = 0; i < ROWS; ++i) c.a[i] += step * c.s[i];
        }
        EACH(k, w.limits) w.la[k] += step * w.ls[k];
        step_ties(w, step);
        SYNC
        done |= exact;
        if (!VANY(VNOT(done))) break;
    }
}
#endif
PRIMAL
// Force of a contact along normal and tangents
INLINE void contact_force(const Contact& c, T* f) {
    T second[CURVE], first[PUSH];
    derive(c, second, first);
    for (int i = 0; i < PUSH; ++i) f[i] = -first[i];
}
// All forces: the constraints' are added to the others'. Where the solver comes to the minimum these are what the
// accelerations ask for, which has less rounding than the rows: there stiff ones multiply that of their distances.
FN void add_forces(World& w, I alone) {
#if !FEW
    EACH(i, NV) w.fs[i] += alone ? zero() : w.ma[i];
#elif COOPERATE
    EACH(n, w.contacts) contact_force(w.con[n], w.con[n].push);
    SYNC
    add_contacts(w, nullptr, w.fs);
#else
    for (int n = 0; n < w.contacts; ++n) {
        const Contact& c = w.con[w.order[n]];
        T f[PUSH];
        contact_force(c, f);
        for (int k = 0; k < c.count; ++k) w.fs[group_dof[c.group * NNZ + k]] += first_of(c, f, k);
    }
#endif
#if FEW
    EACH(k, w.limits) w.fs[w.ldof[k]] -= w.lside[k] * w.lweight[k] * VMIN(w.la[k], zero());
    SYNC
    add_ties(w, nullptr, w.fs, -1.0f);
#else
    SYNC
#endif
}
