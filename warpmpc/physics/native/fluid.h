// SPDX-License-Identifier: Apache-2.0
// Forces of a medium on every body as a box of its inertia (MuJoCo, "Computation: Fluid forces"): a sphere of its mean
// size in a viscous one, faces and edges that a dense one resists.
#if WET
INLINE T wet_edge(const World& w, int n, int k) {
    const int at = wet_box_at[3 * n + k];
    return at >= 0 ? w.par[at] : splat(wet_box[3 * n + k]);
}
FN void resist(World& w) {
    EACH(n, WET) {
        const int mark = wet_mark[n];
        const T* turn = w.mark_turn[mark];
        const V3 fast = load(w.mark_speed[mark]) - vector(wind), spin = load(w.mark_spin[mark]);
        const T b[3] = {wet_edge(w, n, 0), wet_edge(w, n, 1), wet_edge(w, n, 2)};
        const T size = (b[0] + b[1] + b[2]) * (1.0f / 3.0f), density = splat(medium[0]);
        const T round = 3.14159265f * medium[1] * size;
        V3 force = {zero(), zero(), zero()}, torque = force;
        for (int i = 0; i < 3; ++i) {
            const V3 axis = {turn[i], turn[3 + i], turn[6 + i]};
            const T v = dot(axis, fast), o = dot(axis, spin), u = b[(i + 1) % 3], x = b[(i + 2) % 3];
            const T push = 3.0f * round + 0.5f * density * u * x * VABS(v);
            const T twist = round * size * size + density * b[i] * (u * u * u * u + x * x * x * x) * VABS(o) * (1.0f / 64.0f);
            force = force - axis * (push * v);
            torque = torque - axis * (twist * o);
        }
        w.wet_force[n] = force;
        w.wet_torque[n] = torque;
    }
    SYNC
    EACH(i, NV) {
        const V3 turn = load(w.cw[i]), slide = load(w.cl[i]), point = load(w.ref[dof_top[i]]);
        T sum = zero();
        for (int k = wet_first[i]; k < wet_first[i + 1]; ++k) {
            const int n = wet_body[k];
            const V3 lever = slide + cross(turn, load(w.mark_at[wet_mark[n]]) - point);
            sum += dot(lever, w.wet_force[n]) + dot(turn, w.wet_torque[n]);
        }
        w.fs[i] += sum;
    }
    SYNC
}
#endif
