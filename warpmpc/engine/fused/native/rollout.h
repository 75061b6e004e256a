// SPDX-License-Identifier: Apache-2.0
// A rollout of as many worlds as a number has lanes: from the state they start in to what is recorded of them.
const int worlds = k.control.shape[1], steps = k.control.shape[0], controls = k.control.shape[2];
#if defined(__CUDA_ARCH__)
const int lanes = 1, row = first + group;
#else
const int lanes = LANES, row = first + group * LANES;
#endif
const int count = end - row < lanes ? end - row : lanes;
#if COOPERATE
__shared__ Sim::World w;  // of the whole warp, which is a block
for (int i = 0; i < NH; ++i) w.mm[i] = 0.0f;  // where branches do not meet it stays so
#else
Sim::World w;
#endif
const int order[7] = {0, 1, 2, 6, 3, 4, 5};  // of poses, to MuJoCo's quaternions
for (int l = 0; l < lanes; ++l) {
    const size_t from = row + (l < count ? l : count - 1);
    const double* initial = (const double*)k.initial.data + from * k.initial.shape[1] + 1;
    for (int i = 0; i < NQ; ++i) LANE(w.q[i], l) = (float)initial[i];
    for (int i = 0; i < NV; ++i) LANE(w.v[i], l) = (float)initial[NQ + i];
#if ACTS
    for (int i = 0; i < ACTS; ++i) LANE(w.act[i], l) = (float)initial[NQ + NV + i];
#endif
    const float* mocap = (const float*)k.mocap.data + 7 * from * k.mocap.shape[1];
    for (int i = 0; i < 7 * NMOCAP; ++i) LANE(w.mocap[i], l) = mocap_start[i];
    for (int i = 0; i < MOCAPS; ++i)
        for (int n = 0; n < 7; ++n) LANE(w.mocap[7 * mocap_of[i] + n], l) = mocap[7 * i + order[n]];
    const float* moved = (const float*)k.movable.data + 7 * from * k.movable.shape[1];
    for (int i = 0; i < MOVABLES; ++i)
        for (int n = 0; n < 7; ++n) LANE(w.mocap[7 * movable_of[i] + n], l) = moved[7 * i + order[n]];
    for (int i = 0; i < PARAMETERS; ++i) LANE(w.par[i], l) = k.par.data[(size_t)i * worlds + from];
}
for (int i = 0; i < NV; ++i) w.x[i] = (T)0.0f;
w.given = (const float*)k.given.data;
w.overflow = 0;
SYNC
Sim::place(w);
Sim::move(w);
SYNC
for (int h = 0; h < steps; ++h) {
    T c[NCONTROL];
    for (int l = 0; l < lanes; ++l) {
        const size_t of = (size_t)h * worlds + row + (l < count ? l : count - 1);
        const float* from = (const float*)k.control.data + of * controls;
        for (int u = 0; u < controls; ++u) LANE(c[u], l) = from[u];
    }
    CONTROLS
    SYNC
    const int substeps = k.substeps.data[h];
#if WATCHED
    float* const pushed = (float*)k.force.data + ((size_t)h * worlds + row) * 3 * k.force.shape[2];
    for (int i = 0; i < 3 * k.force.shape[2] * count; ++i) pushed[i] = 0.0f;
    const float share = 1.0f / substeps;  // the mean over the physics steps
#endif
    for (int n = 0; n < substeps; ++n) {
        Sim::step(w);
#if WATCHED
        for (int i = 0; i < w.contacts; ++i) {
#if COOPERATE
            if (threadIdx.x & 31) break;
#endif
            const Sim::Contact& c = w.con[w.order[i]];
            T push[PUSH];
            Sim::contact_force(c, push);
            const Sim::V3 normal = Sim::load(c.normal), along = Sim::load(c.tangent);
            const Sim::V3 f = normal * push[0] + along * push[1] + Sim::cross(normal, along) * push[2];
            for (int l = 0; l < count; ++l) {
                if (!((c.used >> l) & 1)) continue;
                const int pair = ((const int*)&c.pair)[l];
                for (int i = watch_first[pair]; i < watch_first[pair + 1]; ++i) {
                    float* of = pushed + 3 * (l * k.force.shape[2] + watch_index[i]);
                    const float sign = share * watch_sign[i];
                    of[0] += sign * LANE(f.x, l);
                    of[1] += sign * LANE(f.y, l);
                    of[2] += sign * LANE(f.z, l);
                }
            }
        }
        SYNC
#endif
    }
    RECORD
}
T bad = (T)0.0f;  // not a number where a state is none, one where it is too large
for (int i = 0; i < NV; ++i) bad = VABS(w.v[i]) < 1e10f ? bad : (T)1.0f;
for (int i = 0; i < NQ; ++i) bad = VABS(w.q[i]) < 1e10f ? bad : (T)1.0f;
for (int l = 0; l < count; ++l) {
    k.diverged.data[row + l] = LANE(bad, l) != 0.0f;
    k.overflow.data[row + l] = (w.overflow >> l) & 1;
}
