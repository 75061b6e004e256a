// SPDX-License-Identifier: Apache-2.0
// Forces of a fluid on every body as a box of its inertia (MuJoCo, "Computation: Fluid forces"): a sphere of its mean
// size in a viscous one, faces and edges that a dense one resists.
#if FLUID
INLINE T fluid_edge(const World& w, int n, int k) {
    const int at = fluid_box_at[3 * n + k];
    return at >= 0 ? w.par[at] : splat(fluid_box[3 * n + k]);
}
FN void resist(World& w) {
    EACH(n, FLUID) {
        const int site = fluid_site[n];
        const T* turn = w.site_turn[site];
        const V3 fast = load(w.site_speed[site]) - vector(wind), spin = load(w.site_spin[site]);
        const T b[3] = {fluid_edge(w, n, 0), fluid_edge(w, n, 1), fluid_edge(w, n, 2)};
        const T size = (b[0] + b[1] + b[2]) * (1.0f / 3.0f), density = splat(fluid[0]);
        const T round = 3.14159265f * fluid[1] * size;
        V3 force = {zero(), zero(), zero()}, torque = force;
        for (int i = 0; i < 3; ++i) {
            const V3 axis = {turn[i], turn[3 + i], turn[6 + i]};
            const T v = dot(axis, fast), o = dot(axis, spin), u = b[(i + 1) % 3], x = b[(i + 2) % 3];
            const T push = 3.0f * round + 0.5f * density * u * x * VABS(v);
            const T twist = round * size * size + density * b[i] * (u * u * u * u + x * x * x * x) * VABS(o) * (1.0f / 64.0f);
            force = force - axis * (push * v);
            torque = torque - axis * (twist * o);
#if FLUID_IMPLICIT
            w.fluid_push[n][i] = TIMESTEP * (push + 0.5f * density * u * x * VABS(v));
            w.fluid_twist[n][i] = TIMESTEP * (2.0f * twist - round * size * size);
#endif
        }
        w.fluid_force[n] = force;
        w.fluid_torque[n] = torque;
    }
    SYNC
    EACH(i, NV) {
        const V3 turn = load(w.cw[i]), slide = load(w.cl[i]), point = load(w.ref[dof_top[i]]);
        T sum = zero();
        for (int k = fluid_first[i]; k < fluid_first[i + 1]; ++k) {
            const int n = fluid_body[k];
            const V3 lever = slide + cross(turn, load(w.site_at[fluid_site[n]]) - point);
            sum += dot(lever, w.fluid_force[n]) + dot(turn, w.fluid_torque[n]);
        }
        w.fs[i] += sum;
    }
#if FLUID_IMPLICIT
    EACH(i, NV) {  // what velocity resists of it, between a degree of freedom and those above
        const V3 point = load(w.ref[dof_top[i]]), turning = load(w.cw[i]), sliding = load(w.cl[i]);
        V3 force = {zero(), zero(), zero()}, torque = force;
        for (int k = fluid_first[i]; k < fluid_first[i + 1]; ++k) {
            const int n = fluid_body[k], site = fluid_site[n];
            const T* turn = w.site_turn[site];
            const V3 arm = load(w.site_at[site]) - point, lever = sliding + cross(turning, arm);
            V3 push = {zero(), zero(), zero()};
            for (int a = 0; a < 3; ++a) {
                const V3 axis = {turn[a], turn[3 + a], turn[6 + a]};
                push = push + axis * (dot(axis, lever) * w.fluid_push[n][a]);
                torque = torque + axis * (dot(axis, turning) * w.fluid_twist[n][a]);
            }
            force = force + push;
            torque = torque + cross(arm, push);
        }
        w.damp[i] += dot(sliding, force) + dot(turning, torque);
        for (int k = fluid_above_first[i]; k < fluid_above_first[i + 1]; ++k) {
            const int j = fluid_above[k];
            w.spread[k] += dot(load(w.cl[j]), force) + dot(load(w.cw[j]), torque);
        }
    }
#endif
    SYNC
}
#endif
