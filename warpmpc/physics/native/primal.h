// SPDX-License-Identifier: Apache-2.0
// The constraint solver where it may end before the minimum, since its iterations are few: then results depend on the way,
// and this is MuJoCo's. It begins at the cheaper of the last accelerations and those without constraints, and every
// island (trees that constraints connect) has its own line search and its own end.
// Along the search direction: a length, the cost beyond that at the beginning, and the cost's derivatives
struct Point { T at, cost, d1, d2; };
INLINE Point either(I m, Point a, Point b) {
    return {m ? a.at : b.at, m ? a.cost : b.cost, m ? a.d1 : b.d1, m ? a.d2 : b.d2};
}
struct Islands { I of[TREES], held[TREES]; };  // first tree of each tree's island; trees that a row holds
// Of an island in each lane, what its trees have
INLINE T of_island(const Islands& g, const T* of, int island) {
    T sum = zero();
    for (int t = 0; t < TREES; ++t) sum += g.of[t] == (I)island ? of[t] : zero();
    return sum;
}
// Trees that a row moves are one island; lanes where that row is there
INLINE void connect(Islands& g, const I* moved) {
    I first = (I)TREES;
    for (int t = 0; t < TREES; ++t) first = (moved[t] & (g.of[t] < first)) ? g.of[t] : first;
    I old[TREES];
    for (int t = 0; t < TREES; ++t) old[t] = g.of[t], g.held[t] |= moved[t];
    for (int t = 0; t < TREES; ++t)
        for (int u = 0; u < TREES; ++u) g.of[t] = (moved[u] & (old[t] == old[u])) ? first : g.of[t];
}
INLINE void none(I* moved) {
    for (int t = 0; t < TREES; ++t) moved[t] = NO;
}
FN void find_islands(World& w, Islands& g) {
    I moved[TREES];
    for (int t = 0; t < TREES; ++t) g.of[t] = (I)t, g.held[t] = NO;
    for (int n = 0; n < w.contacts; ++n) {
        const Contact& c = w.con[n];
        none(moved);
        for (int k = 0; k < c.count; ++k)
            for (int i = 0; i < ROWS; ++i) moved[dof_tree[group_dof[c.group * NNZ + k]]] |= (c.jac[ROWS * k + i] != 0.0f) & (c.weight > 0.0f);
        connect(g, moved);
    }
    for (int k = 0; k < w.limits; ++k) {
        none(moved);
        moved[dof_tree[w.ldof[k]]] = w.lweight[k] > 0.0f;
        connect(g, moved);
    }
#if DRY
    for (int k = 0; k < DRY; ++k) {
        none(moved);
        moved[dof_tree[dry_dof[k]]] = YES;
        connect(g, moved);
    }
#endif
#if CONSTRAINTS
    for (int k = 0; k < CONSTRAINTS; ++k) {
        none(moved);
        for (int n = 0; n < constraint_count[k]; ++n)
            moved[dof_tree[constraint_dof[k * CONSTRAINT_DOFS + n]]] |= w.constraint_weight[k] > 0.0f;
        connect(g, moved);
    }
#endif
}
// Island of a contact's lanes
INLINE I island_of(const Islands& g, const Contact& c) {
#if TREES == 1
    return (I)0;
#else
    I out = (I)-1;
    for (int k = 0; k < c.count; ++k)
        for (int i = 0; i < ROWS; ++i) out = c.jac[ROWS * k + i] != 0.0f ? g.of[dof_tree[group_dof[c.group * NNZ + k]]] : out;
    return out;
#endif
}
// Cost of a row whose derivative is its weight times its acceleration, within bounds
INLINE T cost_of(T weight, T a, float low, float high) {
    const T x = weight * a, bound = between(x, low, high);
    return weight > 0.0f ? bound * (a - 0.5f * bound / VMAX(weight, splat(1e-20f))) : zero();
}
// The cost at a length of the search direction, of one island, or of all if it is below zero; q: derivatives of what
// accelerations alone cost
FN void evaluate(World& w, const Islands& g, int island, T q1, T q2, T at, Point& p) {
    T cost = zero(), d1 = cost, d2 = cost;
    I changed = NO;
    EACH(n, w.contacts) {
        const Contact& c = w.con[n];
        T one = zero(), two = one;
        slope_contact(c, at, one, two, changed);
        const I m = island < 0 ? YES : w.con_island[n] == (I)island;
        cost += m ? cost_contact(c, at) - cost_contact(c, zero()) : zero();
        d1 += m ? one : zero();
        d2 += m ? two : zero();
    }
#define ROW(DOF, WEIGHT, A, S, LOW, HIGH)                                                            \
    {                                                                                                \
        T one = zero(), two = one;                                                                   \
        slope_of(WEIGHT, A, S, at, LOW, HIGH, one, two, changed);                                    \
        const I m = island < 0 ? YES : g.of[dof_tree[DOF]] == (I)island;                         \
        cost += m ? cost_of(WEIGHT, A + at * S, LOW, HIGH) - cost_of(WEIGHT, A, LOW, HIGH) : zero(); \
        d1 += m ? one : zero();                                                                      \
        d2 += m ? two : zero();                                                                      \
    }
    EACH(k, w.limits) ROW(w.ldof[k], w.lweight[k], w.la[k], w.ls[k], -3e38f, 0.0f)
#if DRY
    EACH(k, DRY) ROW(dry_dof[k], w.dry_weight[k], w.dry_a[k], w.dry_s[k], -dry_force[k], dry_force[k])
#endif
#if CONSTRAINTS
    EACH(k, CONSTRAINTS)
        ROW(constraint_dof[k * CONSTRAINT_DOFS], w.constraint_weight[k], w.constraint_a[k], w.constraint_s[k], constraint_low[k], constraint_high[k])
#endif
#undef ROW
    p.at = at;
    p.cost = total(cost) + at * (q1 + 0.5f * at * q2);
    p.d1 = total(d1) + q1 + at * q2;
    p.d2 = total(d2) + q2;
}
INLINE T newton_point(const Point& p) { return p.at - p.d1 / VMAX(p.d2, splat(1e-15f)); }
// A bracket's end moves to the best of three points on its side, and the next point is looked at
INLINE I narrow(World& w, const Islands& g, int island, T q1, T q2, I on, Point& p, const Point* other, Point& next, T& looks) {
    I moved = NO;
    for (int i = 0; i < 3; ++i) {
        const T d = other[i].d1;
        const I better = on & (((p.d1 < 0.0f) & (d < 0.0f) & (p.d1 < d)) | ((p.d1 > 0.0f) & (d > 0.0f) & (p.d1 > d)));
        p = either(better, other[i], p);
        moved |= better;
    }
    if (VANY(moved)) {
        Point q;
        evaluate(w, g, island, q1, q2, newton_point(p), q);
        next = either(moved, q, next);
        looks += moved ? splat(1.0f) : zero();
    }
    return moved;
}
// Length of a step along the search direction in lanes of an island that look for one, and how much less it costs; ends
// after as many looks as MuJoCo's does
FN T line_search(World& w, const Islands& g, int island, T q1, T q2, T tolerance, I on, T& gain) {
    Point begin, p, q, out;
    evaluate(w, g, island, q1, q2, zero(), begin);
    tolerance = VMAX(tolerance, LEAST_SLOPE * VMAX(VABS(q1), VABS(begin.d1)));
    evaluate(w, g, island, q1, q2, newton_point(begin), p);
    T looks = splat(2.0f);
    out = p;
    on &= VNOT(VABS(p.d1) < tolerance);
    const T way = p.d1 < 0.0f ? splat(1.0f) : splat(-1.0f);
    Point far = begin;
    for (I ahead = on; true;) {  // on one side of the minimum
        ahead &= (p.d1 * way <= -tolerance) & (looks < LOOKS);
        if (!VANY(ahead)) break;
        far = either(ahead, p, far);
        evaluate(w, g, island, q1, q2, newton_point(p), q);
        p = either(ahead, q, p);
        looks += ahead ? splat(1.0f) : zero();
    }
    out = either(on, p, out);
    on &= VNOT(VABS(p.d1) < tolerance) & (looks < LOOKS);
    if (VANY(on)) {
        Point next = p, beyond = p;
        evaluate(w, g, island, q1, q2, newton_point(p), next);
        looks += on ? splat(1.0f) : zero();
        while (true) {  // between two sides
            const I more = on & (looks < LOOKS);
            if (!VANY(more)) break;
            Point of[3] = {next, beyond, p};
            evaluate(w, g, island, q1, q2, 0.5f * (p.at + far.at), of[2]);
            looks += more ? splat(1.0f) : zero();
            I found = NO;
            Point best = of[2];
            for (int i = 0; i < 3; ++i) {
                const I good = more & (VABS(of[i].d1) < tolerance) & (VNOT(found) | (of[i].cost < best.cost));
                best = either(good, of[i], best);
                found |= good;
            }
            const I left = more & VNOT(found);
            const I moved = narrow(w, g, island, q1, q2, left, p, of, next, looks) | narrow(w, g, island, q1, q2, left, far, of, beyond, looks);
            out = either(more & (found | VNOT(moved)), best, out);  // as exact as numbers are, where nothing moves
            on &= VNOT(more) | (left & moved);
        }
        const I here = on & (p.cost <= far.cost) & (p.cost < 0.0f), there = on & VNOT(here) & (far.cost < 0.0f);
        out = either(here, p, either(there, far, out));
        out.at = on & VNOT(here | there) ? zero() : out.at;
    }
    gain = -out.cost;
    return out.at;
}
// Rows' parts of the search direction
INLINE void project_search(World& w) {
    project(w, ~0u, w.search, &Contact::s);
    EACH(k, w.limits) w.ls[k] = w.lside[k] * w.search[w.ldof[k]];
    search_ties(w);
    multiply(w.mm, w.search, w.mv);
    SYNC
}
// Steps along the search direction, by trees
INLINE void take(World& w, const T* step) {
    EACH(i, NV) {
        w.x[i] += step[dof_tree[i]] * w.search[i];
        w.ma[i] += step[dof_tree[i]] * w.mv[i];
    }
    SYNC
    project_accelerations(w);
}
FN void newton(World& w, I done) {
    T step[TREES], weight[TREES], q1[TREES], q2[TREES], square[TREES], slope[TREES], down[TREES];
    I over[TREES];
    Islands g;
    find_islands(w, g);
    EACH(n, w.contacts) w.con_island[n] = island_of(g, w.con[n]);
    free_accelerations(w);
    SYNC
    EACH(i, NV) w.search[i] -= w.x[i];
    SYNC
    multiply(w.mm, w.x, w.ma);
    SYNC
    EACH(i, NV) w.ma[i] -= w.fs[i];
    project_accelerations(w);
    project_search(w);
    T a = zero(), b = a;
    EACH(i, NV) a += w.search[i] * w.ma[i], b += w.search[i] * w.mv[i];
    Point free;
    evaluate(w, g, -1, total(a), total(b), splat(1.0f), free);
    for (int t = 0; t < TREES; ++t) {
        over[t] = VNOT(g.held[t]);
        step[t] = (over[t] | (free.cost < 0.0f) | (WARM ? NO : YES)) ? splat(1.0f) : zero();
        weight[t] = zero();
    }
    take(w, step);
    for (int i = 0; i < NV; ++i) weight[dof_tree[i]] += w.mm[i * (i + 1) / 2 + i];
    for (int iteration = 0; iteration < ITERATIONS; ++iteration) {
        descend(w, VBITS(VNOT(done)));
        SYNC
        project_search(w);
        for (int t = 0; t < TREES; ++t) q1[t] = q2[t] = square[t] = slope[t] = down[t] = step[t] = zero();
        for (int i = 0; i < NV; ++i) {
            const int t = dof_tree[i];
            q1[t] += w.search[i] * w.ma[i];
            q2[t] += w.search[i] * w.mv[i];
            square[t] += w.search[i] * w.search[i];
            slope[t] += w.grad[i] * w.grad[i];
            down[t] -= 0.5f * w.search[i] * w.grad[i];
        }
        I all = YES;
        for (int t = 0; t < TREES; ++t) {  // every island once, by its first tree
            const T scale = 1.0f / VMAX(of_island(g, weight, t), splat(1e-30f)), length = VSQRT(of_island(g, square, t));
            const I level = scale * VSQRT(of_island(g, slope, t)) < TOLERANCE, low = scale * of_island(g, down, t) < TOLERANCE;
            I on = VNOT(over[t]) & (g.of[t] == (I)t) & VNOT(done);
            on &= VNOT(iteration ? level | low : level & low) & (length == length);
            if (!VANY(on)) continue;
            T gain;
            const T a1 = of_island(g, q1, t), a2 = of_island(g, q2, t);
            const T at = line_search(w, g, t, a1, a2, (TOLERANCE * LINE_TOLERANCE) * length / scale, on, gain);
            const I end = (at == 0.0f) | ((gain > 0.0f) & (scale * gain < TOLERANCE));
            for (int u = 0; u < TREES; ++u) step[u] = (on & (g.of[u] == (I)t)) ? at : step[u];
            over[t] = VNOT(on & VNOT(end));
            all &= over[t];
        }
        take(w, step);
        if (!VANY(VNOT(all | done))) break;
    }
}
