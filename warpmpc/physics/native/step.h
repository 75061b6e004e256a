// SPDX-License-Identifier: Apache-2.0
// One step of all lanes: collisions, limits, solver, integration (MuJoCo, "Computation: Simulation pipeline").

// Lanes whose geoms' bounding spheres meet
INLINE I near_spheres(World& w, int pair, int a, int b) {
    const V3 d = load(w.gpos[a]) - load(w.gpos[b]);
    const float reach = bound(w, a) + bound(w, b) + pair_margin[pair];
    return dot(d, d) < reach * reach;
}
// Lanes where the sphere around one geom meets a box
INLINE I near_box(World& w, int pair, int g, int box) {
    const V3 c = along_axes(w.gmat[box], load(w.gpos[g]) - load(w.gpos[box]));
    const float reach = bound(w, g) + pair_margin[pair];
    const V3 o = {VMAX(VABS(c.x) - gsize(w, box, 0), zero()), VMAX(VABS(c.y) - gsize(w, box, 1), zero()),
                  VMAX(VABS(c.z) - gsize(w, box, 2), zero())};
    return dot(o, o) < reach * reach;
}
// Lanes where the sphere around a geom meets a plane
INLINE I near_plane(World& w, int pair, int plane, int g) {
    const V3 n = axis_of(w, plane, 2);
    return dot(load(w.gpos[g]) - load(w.gpos[plane]), n) < bound(w, g) + pair_margin[pair];
}
FN void collide(World& w) {
    w.contacts = 0;
#if COOPERATE
    w.found = 0;
    SYNC
#endif
    COLLISIONS
    gather(w);
}
INLINE void turn(T* q, V3 omega, float time) {  // a quaternion by an angular velocity in its own frame
    const T speed = VSQRT(dot(omega, omega));
    const T half = 0.5f * time * speed;
    SINCOS_HALF
    const T scale = speed > 1e-9f ? sine / speed : splat(0.5f * time);
    const V3 o = omega * scale;
    const T a = q[0], x = q[1], y = q[2], z = q[3];
    const T na = a * cosine - x * o.x - y * o.y - z * o.z, nx = a * o.x + x * cosine + y * o.z - z * o.y;
    const T ny = a * o.y - x * o.z + y * cosine + z * o.x, nz = a * o.z + x * o.y - y * o.x + z * cosine;
    const T inv = 1.0f / VSQRT(na * na + nx * nx + ny * ny + nz * nz);
    q[0] = na * inv;
    q[1] = nx * inv;
    q[2] = ny * inv;
    q[3] = nz * inv;
}
// Coordinates, moved on at velocities v for a time
INLINE void displace(World& w, const T* v, float time) {
    EACH(k, SCALARS) w.q[scalar_q[k]] += time * v[scalar_dof[k]];
    EACH(k, TURNING) {
        T* q = w.q + turning_q[k];
        const T* rate = v + turning_dof[k];
        if (turning_free[k]) {
            for (int i = 0; i < 3; ++i) q[i] += time * rate[i];
            turn(q + 3, load(rate + 3), time);
        } else
            turn(q, load(rate), time);
    }
    SYNC
}
// Accelerations of all forces, into w.search: with those that resist velocity implicit, where the integrator has them so
FN void respond(World& w, I alone) {
#if EXPLICIT
    if (VANY(alone)) free_accelerations(w);
    EACH(i, NV) w.search[i] = alone ? w.search[i] : w.x[i];
#elif SKEWED
    solve_skewed(w);
#elif COOPERATE
    EACH(i, NH) w.h[i] = w.mm[i];
    SYNC
#if SPREAD
    EACH(k, SPREAD) w.h[spread_place[k]] += w.spread[k];
#endif
    EACH(i, NV) w.h[i * (i + 1) / 2 + i] += w.damp[i];
    SYNC
    solve_lanes(w.h, w.fs, w.search, 1.0f);
#elif SPREAD
    copy_tree(w.mm, w.h);
    for (int k = 0; k < SPREAD; ++k) w.h[spread_place[k]] += w.spread[k];
    solve_damped(w.h, w.fs, w.search, 1.0f, w.damp);
#else
    solve_damped(w.mm, w.fs, w.search, 1.0f, w.damp);
#endif
    gyroscopic(w);
    SYNC
}
// Forces, and the constraints' with them; lanes that nothing constrains
INLINE I push(World& w) {
#if TENDONS
    stretch(w);
#if TENDON_MASSES
    SYNC
    EACH(k, TENDON_MASSES) w.mm[tendon_mass_place[k]] += w.tendon_mass[k];
    SYNC
#endif
#endif
    drive(w);
    SYNC
#if FLUID
    resist(w);
#endif
    collide(w);
    limit(w);
#if CONSTRAINTS
    bind(w);
#endif
#if DRY
    dry(w);
#endif
    SYNC
    I alone = untied(w);
    for (int n = 0; n < w.contacts; ++n) alone &= VNOT(w.con[n].weight > 0.0f);
    for (int k = 0; k < w.limits; ++k) alone &= VNOT(w.lweight[k] > 0.0f);
    if (VANY(VNOT(alone))) {
        newton(w, alone);
#if !EXPLICIT
        add_forces(w, alone);
#endif
    }
    return alone;
}
// Where the solver begins next: at accelerations that nothing constrained
INLINE void keep_start(World& w, I alone) {
    EACH(i, NV) w.x[i] = alone ? w.search[i] : w.x[i];
}
#if SENSED
// Readings of sensors in the state that everything has been moved to; the solver's start is left as it is
FN void forward(World& w) {
#if SENSES_FORCES
    EACH(i, NV) w.kept_x[i] = w.x[i];
    SYNC
    const I alone = push(w);
    sense(w, alone);
    SYNC
    EACH(i, NV) w.x[i] = w.kept_x[i];
#else
#if TENDONS
    stretch(w);
#endif
    drive(w);
    SYNC
    sense(w, YES);
#endif
    SYNC
}
#endif
// A step; before it everything has been moved to where the coordinates say, after it again
#if RUNGE_KUTTA
INLINE void copy(const T* from, T* to, int count) {
    EACH(i, count) to[i] = from[i];
}
// Runge-Kutta of order 4: accelerations at the start, at two midpoints and at an end, each with all constraints. As in
// MuJoCo the solver begins at those of the step before, and activations keep to their bounds at the end alone.
FN void step(World& w) {
    copy(w.q, w.begun_q, NQ);
    copy(w.v, w.begun_v, NV);
    copy(w.x, w.begun_x, NV);
#if ACTS
    copy(w.act, w.begun_act, ACTS);
#endif
    for (int stage = 0; stage < 4; ++stage) {
        const I alone = push(w);
        if (!stage) sense(w, alone);
        respond(w, alone);
        const float share = stage % 3 ? 1.0f / 3.0f : 1.0f / 6.0f, ahead = stage == 2 ? 1.0f : 0.5f;
        EACH(i, NV) {
            w.mean_v[i] = (stage ? w.mean_v[i] : zero()) + share * w.v[i];
            w.mean_a[i] = (stage ? w.mean_a[i] : zero()) + share * w.search[i];
        }
#if ACTS
        EACH(i, ACTS) {
            const T more = w.act_next[i] - w.act[i];
            w.mean_act[i] = (stage ? w.mean_act[i] : zero()) + share * more;
            w.act[i] = w.begun_act[i] + ahead * act_plain[i] * more;
        }
#endif
        copy(w.begun_q, w.q, NQ);
        SYNC
        if (stage == 3) {
            keep_start(w, alone);
            break;
        }
        displace(w, w.v, ahead * TIMESTEP);
        EACH(i, NV) w.v[i] = w.begun_v[i] + ahead * TIMESTEP * w.search[i];
        copy(w.begun_x, w.x, NV);
        SYNC
        move(w);
        SYNC
    }
    displace(w, w.mean_v, TIMESTEP);
    EACH(i, NV) w.v[i] = w.begun_v[i] + TIMESTEP * w.mean_a[i];
#if ACTS
    EACH(i, ACTS) w.act[i] = between(w.begun_act[i] + w.mean_act[i], act_range[2 * i], act_range[2 * i + 1]);
#endif
    SYNC
    move(w);
    SYNC
}
#else
FN void step(World& w) {
    const I alone = push(w);
    sense(w, alone);
    respond(w, alone);
    EACH(i, NV) w.v[i] += TIMESTEP * w.search[i];
    keep_start(w, alone);
    SYNC
#if ACTS
    EACH(i, ACTS) w.act[i] = w.act_next[i];
#endif
    displace(w, w.v, TIMESTEP);
    move(w);
    SYNC
}
#endif
