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
INLINE void turn(T* q, V3 omega) {  // a quaternion by an angular velocity in its own frame
    const T speed = VSQRT(dot(omega, omega));
    const T half = 0.5f * TIMESTEP * speed;
    SINCOS_HALF
    const T scale = speed > 1e-9f ? sine / speed : splat(0.5f * TIMESTEP);
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
FN void integrate(World& w, I alone) {
#if COOPERATE
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
    EACH(i, NV) {
        w.v[i] += TIMESTEP * w.search[i];
        w.x[i] = alone ? w.search[i] : w.x[i];
    }
    SYNC
#if ACTS
    EACH(i, ACTS) w.act[i] = w.act_next[i];
#endif
    EACH(k, SCALARS) w.q[scalar_q[k]] += TIMESTEP * w.v[scalar_dof[k]];
    EACH(k, TURNING) {
        T* q = w.q + turning_q[k];
        const T* v = w.v + turning_dof[k];
        if (turning_free[k]) {
            for (int i = 0; i < 3; ++i) q[i] += TIMESTEP * v[i];
            turn(q + 3, load(v + 3));
        } else
            turn(q, load(v));
    }
    SYNC
}
// A step; before it everything has been moved to where the coordinates say, after it again
FN void step(World& w) {
#if TENDONS
    stretch(w);
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
    I alone = untied(w);  // lanes that nothing constrains
    for (int n = 0; n < w.contacts; ++n) alone &= VNOT(w.con[n].weight > 0.0f);
    for (int k = 0; k < w.limits; ++k) alone &= VNOT(w.lweight[k] > 0.0f);
    if (VANY(VNOT(alone))) {
        newton(w, alone);
        add_forces(w);
    }
    integrate(w, alone);
    move(w);
    SYNC
}
