// SPDX-License-Identifier: Apache-2.0
// A rollout of as many worlds of one environment as a number has lanes: from the observed state to what their terms
// cost, or to the record of chosen ones.
const int rollouts = k.knots.shape[1] * k.domains, steps = k.substeps.shape[0], worlds = k.par.shape[1];
const int controls = k.knots.shape[3], wide = k.knots.shape[2] * controls, chosen = k.chosen.shape[0];
#if defined(__CUDA_ARCH__)
const int lanes = 1;
#else
const int lanes = LANES;
#endif
// rows of what is written: worlds, or places among those chosen, of which a group has one environment, too
const int groups = (rollouts + lanes - 1) / lanes, own = group / groups;
const int row = chosen ? group * lanes : own * rollouts + group % groups * lanes;
const int beyond = chosen ? chosen : (own + 1) * rollouts;
const int count = beyond - row < lanes ? beyond - row : lanes;
int world[lanes];
for (int l = 0; l < lanes; ++l) {
    world[l] = row + (l < count ? l : count - 1);
    if (chosen) world[l] = k.chosen.data[world[l]];
}
const int e = world[0] / rollouts, sample = world[0] / k.domains;
const float* theta = (const float*)k.knots.data + (size_t)sample * wide;
I lane_at;  // how far the knots of a lane are from the first one's: domains of a sample share them
for (int l = 0; l < lanes; ++l) ((int*)&lane_at)[l] = (world[l] / k.domains - sample) * wide;
#if COOPERATE
__shared__ Sim::World w;  // of the whole warp, which is a block
EACH(i, NH) w.mm[i] = 0.0f;  // where branches do not meet it stays so
#else
Sim::World w;
#endif
START
SYNC
PLACE_WORLD(w);
MOVE_WORLD(w);
SYNC
#if TERMS
TERMS_START
#endif
for (int h = k.records || FIRST < 0 ? -1 : 0; h < steps; ++h) {
    const bool live = h >= 0;
    const int at = live ? h : 0;
#if TERMS
    TERMS_BEFORE
#endif
    if (live) {
        STEP_CONTROL
        EACH(u, controls) {
            T x = (T)0.0f;
            for (int n = 0; n < KNOTS_USED; ++n) x += share[n] * VGATHER(theta + tap[n] * controls + u, lane_at);
            w.c[u] = VMIN(VMAX(x, k.lower.data[u]), k.upper.data[u]);
        }
        SYNC
        EACH(a, DRIVES) {
            T x = (T)drive_offset[a];
            for (int n = drive_first[a]; n < drive_first[a + 1]; ++n) x += drive_factor[n] * w.c[drive_of[n]];
            w.ctrl[a] = x;
        }
#if WATCHED
        EACH(i, 3 * WATCHED) w.pushed[i] = (T)0.0f;
#endif
        SYNC
        const int substeps = k.substeps.data[h];
        for (int n = 0; n < substeps; ++n) {
            STEP_WORLD(w);
#if WATCHED
            WATCH_WORLD(w);
#endif
        }
#if WATCHED
        const float mean = 1.0f / substeps;
        EACH(i, 3 * WATCHED) w.pushed[i] *= mean;
        SYNC
#endif
    }
    if (k.records) RECORD
#if TERMS
    if (!chosen) {
        TERMS_STEP
    }
#endif
}
T bad = (T)0.0f;  // not a number where a state is none, one where it is too large
for (int i = 0; i < NV; ++i) bad = VABS(w.v[i]) < 1e10f ? bad : (T)1.0f;
for (int i = 0; i < NQ; ++i) bad = VABS(w.q[i]) < 1e10f ? bad : (T)1.0f;
for (int l = 0; l < count; ++l) {
    k.diverged.data[row + l] = LANE(bad, l) != 0.0f;
    k.overflow.data[row + l] = (w.overflow >> l) & 1;
}
#if OWN_STATE
for (int l = 0; l < (k.reached.shape[1] ? count : 0); ++l) {  // where worlds that have a start of their own end
    double* reached = (double*)k.reached.data + (size_t)(row + l) * k.reached.shape[1] + 1;
    EACH(i, NQ) reached[i] = LANE(w.q[i], l);
    EACH(i, NV) reached[NQ + i] = LANE(w.v[i], l);
#if ACTS
    EACH(i, ACTS) reached[NQ + NV + i] = LANE(w.act[i], l);
#endif
}
#endif
#if TERMS
if (!chosen) {
    TERMS_END
}
#endif
SYNC  // what other lanes recorded is read next
