// SPDX-License-Identifier: Apache-2.0
// Trees of bodies for the lanes of a warp, level by level: the formulas of tree.py, a body, an axis or an entry of the
// mass matrix to a lane. Spatial vectors are taken about a point of each tree (Featherstone 2008, chapters 5 and 6).
#if COOPERATE
INLINE void store(V3 v, T* to) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }
INLINE void moved(Motion& m, V3 turn, V3 slide) {
    m.turning = m.turning + cross(m.angular, turn);
    m.falling = m.falling + cross(m.angular, slide) + cross(m.linear, turn);
    m.angular = m.angular + turn;
    m.linear = m.linear + slide;
}
// Three degrees of freedom from i on that turn about the columns of a body, at an arm from the tree's point
INLINE void spun(World& w, int i, const Frame& f, V3 arm, Motion& m) {
    const V3 axes[3] = {f.x, f.y, f.z};
    for (int k = 0; k < 3; ++k) {
        store(axes[k], w.cw[i + k]);
        store(cross(axes[k], arm), w.cl[i + k]);
    }
    const V3 spin = f.turned(load(w.v + i));
    moved(m, spin, cross(spin, arm));
}
// A body after its joints
INLINE void descend_to(World& w, int b) {
    const int above = moving_above[b];
    Frame f = {{1.0f, 0.0f, 0.0f}, {0.0f, 1.0f, 0.0f}, {0.0f, 0.0f, 1.0f}, {0.0f, 0.0f, 0.0f}};
    const V3 none = {0.0f, 0.0f, 0.0f};
    Motion m = {none, none, none, vector(gravity) * -1.0f};
    if (above >= 0) {
        f = w.frame[above];
        m = w.motion[above];
    }
    f.p = f.at(moving_at + 3 * b);
    f.turn(moving_turn + 9 * b);
    T* const reference = w.ref[moving_top[b]];
    bool referred = above >= 0;
    for (int j = moving_joint[b]; j < moving_joint[b] + moving_joints[b]; ++j) {
        const T *q = w.q + joint_q[j], *v = w.v + joint_dof[j];
        const int i = joint_dof[j];
        if (joint_kind[j] == FREE_JOINT) {
            f.p = load(q);
            f.x = {1.0f, 0.0f, 0.0f}, f.y = {0.0f, 1.0f, 0.0f}, f.z = {0.0f, 0.0f, 1.0f};
            f.orient(q[3], q[4], q[5], q[6]);
            store(f.p, reference);
            referred = true;
            for (int k = 0; k < 3; ++k)
                for (int c = 0; c < 3; ++c) w.cw[i + k][c] = 0.0f, w.cl[i + k][c] = k == c ? 1.0f : 0.0f;
            m.linear = m.linear + load(v);
            spun(w, i + 3, f, none, m);
            continue;
        }
        const V3 anchor = f.at(joint_at + 3 * j), axis = f.turned(vector(joint_axis + 3 * j));
        if (joint_kind[j] == SLIDE_JOINT) {
            f.p = f.p + axis * (q[0] - joint_zero[j]);
            store(none, w.cw[i]);
            store(axis, w.cl[i]);
            moved(m, none, axis * v[0]);
            continue;
        }
        if (!referred) store(anchor, reference);
        referred = true;
        const V3 arm = load(reference) - anchor;
        if (joint_kind[j] == BALL_JOINT) f.orient(q[0], q[1], q[2], q[3]);
        else {
            const T angle = q[0] - joint_zero[j];
            SINCOS_ANGLE
            const float* a = joint_axis + 3 * j;  // Rodrigues: half the angle as a quaternion
            f.orient(half_cosine, half_sine * a[0], half_sine * a[1], half_sine * a[2]);
        }
        f.p = anchor - f.turned(vector(joint_at + 3 * j));
        if (joint_kind[j] == BALL_JOINT) spun(w, i, f, arm, m);
        else {
            const V3 slide = cross(axis, arm);
            store(axis, w.cw[i]);
            store(slide, w.cl[i]);
            moved(m, axis * v[0], slide * v[0]);
        }
    }
    if (!referred) store(f.p, reference);
    w.frame[b] = f;
    w.motion[b] = m;
}
INLINE T mass_of(const World& w, int b, int k) {
#if MASSES_VARY
    const int at = moving_mass_at[10 * b + k];
    if (at >= 0) return w.par[at];
#endif
    return moving_mass[10 * b + k];
}
INLINE V3 times(const Inertia& n, V3 v) {
    return {n.xx * v.x + n.xy * v.y + n.xz * v.z, n.xy * v.x + n.yy * v.y + n.yz * v.z,
            n.xz * v.x + n.yz * v.y + n.zz * v.z};
}
// Inertia of a body, and the force that its motion takes
INLINE void weigh(World& w, int b) {
    const Frame f = w.frame[b];
    const Motion m = w.motion[b];
    T c[10];
    for (int k = 0; k < 10; ++k) c[k] = mass_of(w, b, k);
    // columns of R J
    const V3 h[3] = {f.turned({c[4], c[7], c[8]}), f.turned({c[7], c[5], c[9]}), f.turned({c[8], c[9], c[6]})};
    const V3 d = f.turned({c[1], c[2], c[3]}) + f.p - load(w.ref[moving_top[b]]);
    Inertia n;
    n.mass = c[0];
    n.moment = d * n.mass;
    const V3 o = n.moment;
    n.xx = h[0].x * f.x.x + h[1].x * f.y.x + h[2].x * f.z.x + o.y * d.y + o.z * d.z;
    n.yy = h[0].y * f.x.y + h[1].y * f.y.y + h[2].y * f.z.y + o.x * d.x + o.z * d.z;
    n.zz = h[0].z * f.x.z + h[1].z * f.y.z + h[2].z * f.z.z + o.x * d.x + o.y * d.y;
    n.xy = h[0].x * f.x.y + h[1].x * f.y.y + h[2].x * f.z.y - o.x * d.y;
    n.xz = h[0].x * f.x.z + h[1].x * f.y.z + h[2].x * f.z.z - o.x * d.z;
    n.yz = h[0].y * f.x.z + h[1].y * f.y.z + h[2].y * f.z.z - o.y * d.z;
    const V3 felt = m.falling + vector(gravity) * moving_lift[b];
    const V3 spin = times(n, m.angular) + cross(o, m.linear), push = m.linear * n.mass - cross(o, m.angular);
    w.inertia[b] = n;
    w.torque[b] = times(n, m.turning) + cross(o, felt) + cross(m.angular, spin) + cross(m.linear, push);
    w.force[b] = felt * n.mass - cross(o, m.turning) + cross(m.angular, push);
}
// Poses of bodies and geoms, axes, mass matrix and bias forces, from coordinates and velocities
FN void move(World& w) {
    for (int level = 0; level < LEVELS; ++level) {
        EACH(n, level_first[level + 1] - level_first[level]) descend_to(w, level_body[level_first[level] + n]);
        SYNC
    }
    EACH(b, MOVING) weigh(w, b);
    EACH(n, MOVING_GEOMS) {
        const int g = moving_geom[n];
        Frame f = w.frame[moving_geom_body[n]];
        store(f.at(moving_geom_at + 3 * n), w.gpos[g]);
        f.turn(moving_geom_turn + 9 * n);
        const V3 axes[3] = {f.x, f.y, f.z};
        for (int k = 0; k < 3; ++k) w.gmat[g][k] = axes[k].x, w.gmat[g][3 + k] = axes[k].y, w.gmat[g][6 + k] = axes[k].z;
    }
    EACH(n, KEPT) {
        const int b = kept_body[n], r = kept_row[n];
        const Frame f = w.frame[b];
        const Motion m = w.motion[b];
        store(f.p, w.bpos[r]);
        store(m.angular, w.bang[r]);
        store(m.linear + cross(m.angular, f.p - load(w.ref[moving_top[b]])), w.blin[r]);
        const V3 axes[3] = {f.x, f.y, f.z};
        for (int k = 0; k < 3; ++k) w.bmat[r][k] = axes[k].x, w.bmat[r][3 + k] = axes[k].y, w.bmat[r][6 + k] = axes[k].z;
    }
    SYNC
    // of everything from a body on: what hangs on a body has a higher number; a lane has one of the numbers of all bodies
    const int numbers = sizeof(Inertia) / sizeof(T) + 6;
    for (int k = threadIdx.x & 31; k < numbers; k += 32) {
        for (int b = MOVING - 1; b >= 0; --b) {
            const int above = moving_above[b];
            if (above < 0) continue;
            T* const all[3] = {(T*)w.inertia, (T*)w.torque, (T*)w.force};
            const int part = k < 10 ? 0 : k < 13 ? 1 : 2, wide = part ? 3 : 10, at = part ? (k - 10) % 3 : k;
            all[part][wide * above + at] += all[part][wide * b + at];
        }
    }
    SYNC
    EACH(i, NV) {
        const int b = dof_body[i];
        const V3 turn = load(w.cw[i]), slide = load(w.cl[i]);
        const Inertia n = w.inertia[b];
        w.twist[i] = times(n, turn) + cross(n.moment, slide);
        w.shift[i] = slide * n.mass - cross(n.moment, turn);
        w.bias[i] = dot(turn, w.torque[b]) + dot(slide, w.force[b]);
    }
    SYNC
    EACH(e, ENTRIES) {
        const int i = entry_row[e], j = entry_column[e];
        w.mm[entry_place[e]] = dot(load(w.cw[j]), w.twist[i]) + dot(load(w.cl[j]), w.shift[i]) + (i == j ? dof_armature[i] : 0.0f);
    }
}
#endif
