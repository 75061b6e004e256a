// SPDX-License-Identifier: Apache-2.0
// Trees of bodies for the lanes of a warp: a link, a body, an axis or an entry of the mass matrix to a lane. A link is
// what one joint moves. Spatial vectors are taken about a point of each tree (Featherstone 2008, chapters 5 and 6).
#if COOPERATE
INLINE void store(V3 v, T* to) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }
// A link in the frame of the one above
INLINE Frame link_of(const World& w, int l) {
    Frame f = {{1.0f, 0.0f, 0.0f}, {0.0f, 1.0f, 0.0f}, {0.0f, 0.0f, 1.0f}, vector(link_at + 3 * l)};
    f.turn(link_turn + 9 * l);
    const int j = link_joint[l];
    if (j < 0) return f;
    const T* q = w.q + joint_q[j];
    const int kind = joint_kind[j];
    if (kind == FREE_JOINT) {
        const V3 x = {1.0f, 0.0f, 0.0f}, y = {0.0f, 1.0f, 0.0f}, z = {0.0f, 0.0f, 1.0f};
        f = {x, y, z, load(q)};
        f.orient(q[3], q[4], q[5], q[6]);
        return f;
    }
    const V3 axis = vector(joint_axis + 3 * j), at = vector(joint_at + 3 * j);
    if (kind == SLIDE_JOINT) {
        f.p = f.p + f.turned(axis * (q[0] - joint_zero[j]));
        return f;
    }
    const V3 anchor = f.p + f.turned(at);
    if (kind == BALL_JOINT) f.orient(q[0], q[1], q[2], q[3]);
    else {
        const T angle = q[0] - joint_zero[j];
        SINCOS_ANGLE
        f.orient(half_cosine, half_sine * axis.x, half_sine * axis.y, half_sine * axis.z);
    }
    f.p = anchor - f.turned(at);
    return f;
}
// What velocities along the degrees of freedom of a list add up to, in rotation or at the tree's point
FN V3 total_of(const World& w, bool linear, const short* dof, int first, int end) {
    const T (*axis)[3] = linear ? w.cl : w.cw;
    V3 sum = {0.0f, 0.0f, 0.0f};
    for (int n = first; n < end; ++n) sum = sum + load(axis[dof[n]]) * w.v[dof[n]];
    return sum;
}
// Where links are, by doubling: after round r a link knows its place in the one 2^r above; about which axes they move;
// how fast bodies are, and what accelerates them without joint accelerations
FN void travel(World& w) {
    EACH(l, LINKS) w.link[0][l] = link_of(w, l);
    SYNC
    const Frame* links = w.link[0];
#pragma unroll 1
    for (int r = 0; r < ROUNDS; ++r) {
        Frame* const next = w.link[(r + 1) & 1];
        EACH(l, LINKS) {
            const int above = link_above[r * LINKS + l];
            Frame f = links[l];
            if (above >= 0) {
                const Frame o = links[above];
                f = {o.turned(f.x), o.turned(f.y), o.turned(f.z), o.p + o.turned(f.p)};
            }
            next[l] = f;
        }
        SYNC
        links = next;
    }
    EACH(i, NV) {
        const Frame& f = links[dof_link[i]];
        const Frame& root = links[dof_root[i]];
        const V3 reference = root.p + root.turned(vector(dof_root_at + 3 * i)), local = vector(dof_axis + 3 * i);
        const V3 axis = dof_world[i] ? local : f.turned(local), none = {0.0f, 0.0f, 0.0f};
        const V3 arm = reference - (f.p + f.turned(vector(dof_at + 3 * i)));
        store(dof_turns[i] ? axis : none, w.cw[i]);
        store(dof_turns[i] ? cross(axis, arm) : axis, w.cl[i]);
        if (dof_top[i] == i) store(reference, w.ref[i]);
    }
    SYNC
    EACH(i, NV) {  // what a joint's motion adds to accelerations, from that of the joints above it
        const V3 turn = load(w.cw[i]) * w.v[i], slide = load(w.cl[i]) * w.v[i];
        const V3 angular = total_of(w, false, before_dof, before_first[i], before_first[i + 1]);
        const V3 linear = total_of(w, true, before_dof, before_first[i], before_first[i + 1]);
        w.twist[i] = cross(angular, turn);
        w.shift[i] = cross(angular, slide) + cross(linear, turn);
    }
    SYNC
    EACH(e, 4 * MOVING) {
        const int b = e >> 2, first = chain_first[b], end = chain_first[b + 1];
        Motion& m = w.motion[b];
        if (!(e & 2)) {
            const V3 sum = total_of(w, e & 1, chain_dof, first, end);
            (e & 1 ? m.linear : m.angular) = sum;
        } else {
            V3 sum = e & 1 ? vector(gravity) * -1.0f : V3{0.0f, 0.0f, 0.0f};
            const V3* const from = e & 1 ? w.shift : w.twist;
#pragma unroll 2
            for (int n = first; n < end; ++n) sum = sum + from[chain_dof[n]];
            (e & 1 ? m.falling : m.turning) = sum;
        }
    }
    EACH(b, MOVING) w.frame[b] = links[moving_link[b]];
    SYNC
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
    travel(w);
    EACH(b, MOVING) weigh(w, b);
    EACH(n, MOVING_GEOMS) {
        const int g = moving_geom[n];
        Frame f = w.frame[moving_geom_body[n]];
        store(f.at(moving_geom_at + 3 * n), w.gpos[g]);
        f.turn(moving_geom_turn + 9 * n);
        const V3 axes[3] = {f.x, f.y, f.z};
        for (int k = 0; k < 3; ++k) w.gmat[g][k] = axes[k].x, w.gmat[g][3 + k] = axes[k].y, w.gmat[g][6 + k] = axes[k].z;
    }
#if SITES
    EACH(n, MOVING_MARKS) {
        const int b = moving_mark_body[n], k = moving_mark[n];
        Frame f = w.frame[b];
        const Motion m = w.motion[b];
        const V3 at = f.at(moving_mark_at + 3 * n), arm = at - load(w.ref[moving_top[b]]);
        store(at, w.site_at[k]);
        store(m.angular, w.site_spin[k]);
        store(m.turning, w.site_turning[k]);
        store(m.linear + cross(m.angular, arm), w.site_speed[k]);
        store(m.falling + vector(gravity) + cross(m.turning, arm) + cross(m.angular, m.linear + cross(m.angular, arm)),
              w.site_falling[k]);
        f.turn(moving_mark_turn + 9 * n);
        const V3 axes[3] = {f.x, f.y, f.z};
        T* turn = w.site_turn[k];
        for (int i = 0; i < 3; ++i) turn[i] = axes[i].x, turn[3 + i] = axes[i].y, turn[6 + i] = axes[i].z;
    }
#endif
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
        w.mm[entry_place[e]] = dot(load(w.cw[j]), w.twist[i]) + dot(load(w.cl[j]), w.shift[i]) + entry_armature[e];
    }
}
#endif
