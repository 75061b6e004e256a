// SPDX-License-Identifier: Apache-2.0
// The constraint solver: primal Newton with exact line search (MuJoCo, "Computation: Solver algorithms"), until every
// lane has converged. A lane that has does not change any more, whatever the others do.

INLINE void project(const Contact& c, const T* a, T& y0, T& y1, T& y2) {
    const int* dof = group_dof + c.group * NNZ;
    y0 = y1 = y2 = zero();
    for (int k = 0; k < c.count; ++k) {
        const T b = a[dof[k]];
        const T* j = c.jac + ROWS * k;
        y0 += j[0] * b;
#if ROWS == 3
        y1 += j[1] * b;
        y2 += j[2] * b;
#endif
    }
}
// The edges of a pyramid; without friction they are one row, four times
INLINE void edges(T mu, T a, T b, T c, T* e) {
    const T x = mu * b, y = mu * c;
    e[0] = a + x;
    e[1] = a - x;
    e[2] = a + y;
    e[3] = a - y;
}
// Derivatives of the cost along the search direction, and lanes where an inequality has changed sides
FN void slope(World& w, unsigned live, T step, T& slope1, T& slope2, I& sides) {
    T d1 = zero(), d2 = d1;
    I changed = NO;
    EACH(n, w.contacts) {
        const Contact& c = w.con[w.order[n]];
        if (!(c.used & live)) continue;
        if (!group_slides[c.group]) {
            const T at = c.a0 + step * c.s0;
            const I on = at < 0.0f;
            const T u = on ? c.weight * c.s0 : zero();
            d1 += at * u;
            d2 += u * c.s0;
            changed |= (on ^ (c.a0 < 0.0f)) & (c.weight > 0.0f);
            continue;
        }
        T a[4], s[4];
        edges(c.mu, c.a0, c.a1, c.a2, a);
        edges(c.mu, c.s0, c.s1, c.s2, s);
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
    EACH(k, w.limits) {
        const T at = w.la[k] + step * w.ls[k];
        const I on = at < 0.0f;
        const T u = on ? w.lweight[k] * w.ls[k] : zero();
        d1 += at * u;
        d2 += u * w.ls[k];
        changed |= (on ^ (w.la[k] < 0.0f)) & (w.lweight[k] > 0.0f);
    }
    slope1 += total(d1);
    slope2 += total(d2);
    sides |= some(changed);
}
// Jᵀ D J and Jᵀ f of one contact: H and gradient of N degrees of freedom
INLINE void add_entry(World& w, const Contact& c, int i, int j, T w00, T w01, T w02, T w11, T w22) {
    const T *r = c.jac + ROWS * i, *o = c.jac + ROWS * j;
    T* h = w.h + group_entry[c.group * NTRIANGLE + i * (i + 1) / 2 + j];
#if ROWS == 3
    const T b0 = w00 * r[0] + w01 * r[1] + w02 * r[2], b1 = w01 * r[0] + w11 * r[1], b2 = w02 * r[0] + w22 * r[2];
    *h += b0 * o[0] + b1 * o[1] + b2 * o[2];
#else
    *h += w00 * r[0] * o[0];
#endif
}
INLINE void add_gradient(World& w, const Contact& c, int i, T f0, T f1, T f2, T* to) {
    const T* r = c.jac + ROWS * i;
#if ROWS == 3
    to[group_dof[c.group * NNZ + i]] += r[0] * f0 + r[1] * f1 + r[2] * f2;
#else
    to[group_dof[c.group * NNZ + i]] += r[0] * f0;
#endif
}
INLINE void add_block(const int N, World& w, const Contact& c, T w00, T w01, T w02, T w11, T w22, T f0, T f1, T f2) {
#if COOPERATE
    EACH(e, N * (N + 1) / 2) add_entry(w, c, triangle_row[e], e - triangle_row[e] * (triangle_row[e] + 1) / 2, w00, w01, w02, w11, w22);
    EACH(i, N) add_gradient(w, c, i, f0, f1, f2, w.grad);
    SYNC
#else
    UNROLL for (int i = 0; i < N; ++i) {
        add_gradient(w, c, i, f0, f1, f2, w.grad);
        UNROLL for (int j = 0; j <= i; ++j) add_entry(w, c, i, j, w00, w01, w02, w11, w22);
    }
#endif
}
// Hessian and gradient of the cost
FN void hessian(World& w, unsigned live) {
#if COOPERATE
    EACH(i, NH) w.h[i] = w.mm[i];
#else
    copy_tree(w.mm, w.h);
#endif
    EACH(i, NV) w.grad[i] = w.ma[i];
    SYNC
    for (int n = 0; n < w.contacts; ++n) {
        const Contact& c = w.con[w.order[n]];
        if (!(c.used & live)) continue;
        T w00, w01 = zero(), w02 = w01, w11 = w01, w22 = w01, f0, f1 = w01, f2 = w01;
        if (!group_slides[c.group]) {
            w00 = c.a0 < 0.0f ? c.weight : zero();
            f0 = w00 * c.a0;
        } else {
            T a[4], k[4];
            edges(c.mu, c.a0, c.a1, c.a2, a);
            for (int u = 0; u < 4; ++u) k[u] = a[u] < 0.0f ? c.weight : zero();
            w00 = k[0] + k[1] + k[2] + k[3];
            w01 = c.mu * (k[0] - k[1]);
            w02 = c.mu * (k[2] - k[3]);
            w11 = c.mu * c.mu * (k[0] + k[1]);
            w22 = c.mu * c.mu * (k[2] + k[3]);
            const T e0 = k[0] * a[0], e1 = k[1] * a[1], e2 = k[2] * a[2], e3 = k[3] * a[3];
            f0 = e0 + e1 + e2 + e3;
            f1 = c.mu * (e0 - e1);
            f2 = c.mu * (e2 - e3);
        }
        if (!(VBITS(w00 > 0.0f) & live)) continue;
#if COOPERATE
        add_block(c.count, w, c, w00, w01, w02, w11, w22, f0, f1, f2);
#else
        switch (c.count) {
#define BLOCK(N) case N: add_block(N, w, c, w00, w01, w02, w11, w22, f0, f1, f2); break;
            BLOCKS
#undef BLOCK
        }
#endif
    }
    EACH(k, w.limits) {
        const T u = w.la[k] < 0.0f ? w.lweight[k] : zero();
        const int i = w.ldof[k];
        w.grad[i] += w.lside[k] * u * w.la[k];
        w.h[i * (i + 1) / 2 + i] += u;
    }
    SYNC
}
// Accelerations x that minimize the cost; done: lanes that nothing constrains
FN void newton(World& w, I done) {
    multiply(w.mm, w.x, w.ma);
    SYNC
    EACH(i, NV) w.ma[i] -= w.fs[i];
    EACH(n, w.contacts) {
        Contact& c = w.con[n];
        T y0, y1, y2;
        project(c, w.x, y0, y1, y2);
        c.a0 = y0 - c.ref0;
        c.a1 = y1 - c.ref1;
        c.a2 = y2 - c.ref2;
    }
    EACH(k, w.limits) w.la[k] = w.lside[k] * w.x[w.ldof[k]] - w.lref[k];
    SYNC
    for (int iteration = 0; iteration < ITERATIONS; ++iteration) {
        const unsigned live = VBITS(VNOT(done));
        bool coupled = false;
        for (int n = 0; n < w.contacts; ++n) coupled |= (w.con[n].used & live) && group_couples[w.con[n].group];
        if (coupled && !COOPERATE) for (int i = 0; i < NH; ++i) w.h[i] = zero();
        hessian(w, live);
        if (coupled) solve_coupled(w.h, w.grad, w.search, -1.0f);
        else solve_tree(w.h, w.grad, w.search, -1.0f);
        SYNC
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
            EACH(n, w.contacts) {
                Contact& c = w.con[n];
                if (c.used & live) project(c, w.search, c.s0, c.s1, c.s2);
            }
            EACH(k, w.limits) w.ls[k] = w.lside[k] * w.search[w.ldof[k]];
            SYNC
        }
        for (int tries = 0; tries < LINE_SEARCH && VANY(active); ++tries) {
            T d1 = q1 + step * q2, d2 = q2;
            I changed = NO;
            slope(w, live, step, d1, d2, changed);
            const I good = VABS(d1) < LINE_TOLERANCE * decrement;
            if (!tries) exact |= good & VNOT(changed) & active;  // a whole step within one piece of the cost: its minimum
            active &= VNOT(good);
            low = (active & (d1 < 0.0f)) ? step : low;
            high = (active & (d1 >= 0.0f)) ? step : high;
            T next = step - d1 / d2;
            next = ((next <= low) | (next >= high)) ? 0.5f * (low + VMIN(high, 2.0f * low + 1.0f)) : next;
            step = active ? next : step;
        }
        step = active ? low : step;  // whoever has not come to an end keeps what lies downhill for sure
        EACH(i, NV) {
            w.x[i] = done ? w.x[i] : w.x[i] + step * w.search[i];
            w.ma[i] = done ? w.ma[i] : w.ma[i] + step * w.mv[i];
        }
        step = done ? zero() : step;
        EACH(n, w.contacts) {
            Contact& c = w.con[n];
            if (!(c.used & live)) continue;
            c.a0 += step * c.s0;
            c.a1 += step * c.s1;
            c.a2 += step * c.s2;
        }
        EACH(k, w.limits) w.la[k] += step * w.ls[k];
        SYNC
        done |= exact;
        if (!VANY(VNOT(done))) break;
    }
}
// Force of a contact along normal and tangents
INLINE void contact_force(const Contact& c, T& f0, T& f1, T& f2) {
    f1 = f2 = zero();
    if (!group_slides[c.group]) {
        f0 = -c.weight * VMIN(c.a0, zero());
        return;
    }
    T a[4];
    edges(c.mu, c.a0, c.a1, c.a2, a);
    for (int k = 0; k < 4; ++k) a[k] = -c.weight * VMIN(a[k], zero());
    f0 = a[0] + a[1] + a[2] + a[3];
    f1 = c.mu * (a[0] - a[1]);
    f2 = c.mu * (a[2] - a[3]);
}
// All forces: the constraints' are added to the others'
FN void add_forces(World& w) {
    for (int n = 0; n < w.contacts; ++n) {
        const Contact& c = w.con[w.order[n]];
        T f0, f1, f2;
        contact_force(c, f0, f1, f2);
        EACH(k, c.count) add_gradient(w, c, k, f0, f1, f2, w.fs);
        SYNC
    }
    EACH(k, w.limits) w.fs[w.ldof[k]] -= w.lside[k] * w.lweight[k] * VMIN(w.la[k], zero());
    SYNC
}
