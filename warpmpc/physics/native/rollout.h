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
EACH(i, TURNING) {  // a quaternion of no length is no rotation
    T* const q = w.q + turning_q[i] + (turning_free[i] ? 3 : 0);
    const I none = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] < 1e-30f;
    q[0] = none ? (T)1.0f : q[0];
}
SYNC
// Worlds that diverge stay where they were before that control. One whose start or whose controls are no numbers, or too
// large, takes one more control of zeros, from the model's own coordinates if it is the start (MuJoCo's mj_checkPos).
I gone = NO, doomed = NO;
for (int i = 0; i < NQ; ++i) doomed |= VNOT(VABS(w.q[i]) < 1e10f);
for (int i = 0; i < NV; ++i) doomed |= VNOT(VABS(w.v[i]) < 1e10f);
#if ACTS
for (int i = 0; i < ACTS; ++i) doomed |= VNOT(VABS(w.act[i]) < 1e10f);
EACH(i, ACTS) w.act[i] = doomed ? (T)0.0f : w.act[i];
T kept_act[ACTS];
#endif
SYNC
EACH(i, NQ) w.q[i] = doomed ? (T)rest_q[i] : w.q[i];
EACH(i, NV) w.v[i] = doomed ? (T)0.0f : w.v[i];
SYNC
T kept_q[NQ], kept_v[NV];
#if READINGS
T fresh[READINGS], shown[READINGS];  // what sensors show at the last physics step of a control
for (int i = 0; i < READINGS; ++i) shown[i] = (T)0.0f;
#endif
int passed = 0, held[lanes];  // physics steps, and after how many of them a world stays
for (int l = 0; l < lanes; ++l) held[l] = 0x7fffffff;
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
        I spoiled = NO;
        EACH(u, controls) {
            T x = (T)0.0f;
            for (int n = 0; n < KNOTS_USED; ++n) x += share[n] * VGATHER(theta + tap[n] * controls + u, lane_at);
            w.c[u] = VMIN(VMAX(x, k.lower.data[u]), k.upper.data[u]);
            spoiled |= VNOT(x == x);  // which bounds hide
        }
        SYNC
        EACH(a, DRIVES) {
            T x = (T)drive_offset[a];
            for (int n = drive_first[a]; n < drive_first[a + 1]; ++n) x += drive_factor[n] * w.c[drive_of[n]];
            w.ctrl[a] = x;
            if (drive_free[a]) spoiled |= VABS(x) > 1e10f;
        }
        const int asked = k.substeps.data[h];
        if (asked) doomed |= Sim::some(spoiled);
        if (VANY(doomed)) {
            SYNC
            EACH(a, DRIVES) w.ctrl[a] = doomed ? (T)0.0f : w.ctrl[a];
        }
#if WATCHED
        EACH(i, 3 * WATCHED) w.pushed[i] = (T)0.0f;
#endif
        SYNC
        EACH(i, NQ) kept_q[i] = w.q[i];
        EACH(i, NV) kept_v[i] = w.v[i];
#if ACTS
        EACH(i, ACTS) kept_act[i] = w.act[i];
#endif
        const int substeps = VANY(VNOT(gone)) ? asked : 0;
#if !defined(__CUDA_ARCH__)
        if (VANY(gone) && substeps) {  // lanes that stay go along with another, so that none waits for their solver
            int with = 0;
            while (((int*)&gone)[with]) ++with;
            for (int i = 0; i < NQ; ++i) w.q[i] = gone ? (T)LANE(w.q[i], with) : w.q[i];
            for (int i = 0; i < NV; ++i) w.v[i] = gone ? (T)LANE(w.v[i], with) : w.v[i];
            for (int i = 0; i < NV; ++i) w.x[i] = gone ? (T)LANE(w.x[i], with) : w.x[i];
#if ACTS
            for (int i = 0; i < ACTS; ++i) w.act[i] = gone ? (T)LANE(w.act[i], with) : w.act[i];
#endif
            for (int a = 0; a < DRIVES; ++a) w.ctrl[a] = gone ? (T)LANE(w.ctrl[a], with) : w.ctrl[a];
            MOVE_WORLD(w);
        }
#endif
        for (int n = 0; n < substeps; ++n) {
#if READINGS
            if (n == substeps - 1) READ_BEFORE
            SYNC
#endif
            STEP_WORLD(w);
#if WATCHED
            WATCH_WORLD(w);
#endif
        }
#if READINGS
        if (substeps) READ_AFTER
#endif
#if WATCHED
        const float mean = 1.0f / (substeps ? substeps : 1);
        EACH(i, 3 * WATCHED) w.pushed[i] *= mean;
        SYNC
#endif
        if (asked) {
            I bad = gone;
            for (int i = 0; i < NQ; ++i) bad |= VNOT(VABS(w.q[i]) < 1e10f);
            for (int i = 0; i < NV; ++i) bad |= VNOT(VABS(w.v[i]) < 1e10f) | VNOT(VABS(w.x[i]) < 1e10f);
#if ACTS
            for (int i = 0; i < ACTS; ++i) bad |= VNOT(VABS(w.act[i]) < 1e10f);
#endif
#if READINGS
            for (int i = 0; i < READINGS; ++i) shown[i] = bad ? shown[i] : fresh[i];
#endif
            SYNC
            if (VANY(bad)) {
                EACH(i, NQ) w.q[i] = bad ? kept_q[i] : w.q[i];
                EACH(i, NV) w.v[i] = bad ? kept_v[i] : w.v[i];
                EACH(i, NV) w.x[i] = bad ? (T)0.0f : w.x[i];
#if ACTS
                EACH(i, ACTS) w.act[i] = bad ? kept_act[i] : w.act[i];
#endif
#if WATCHED
                EACH(i, 3 * WATCHED) w.pushed[i] = bad ? (T)0.0f : w.pushed[i];
#endif
                SYNC
                MOVE_WORLD(w);
                SYNC
            }
            if (VANY(bad | doomed))
                for (int l = 0; l < lanes; ++l)
                    if (!((int*)&gone)[l]) {
                        if (((int*)&bad)[l]) held[l] = passed;
                        else if (((int*)&doomed)[l]) held[l] = passed + asked;
                    }
            gone = bad | doomed, doomed = NO;
            passed += asked;
        }
    }
    if (k.records) RECORD
#if TERMS
    if (!chosen) {
        TERMS_STEP
    }
#endif
}
gone |= doomed;
for (int l = 0; l < count; ++l) {
    k.diverged.data[row + l] = ((int*)&gone)[l] != 0;
    k.overflow.data[row + l] = (w.overflow >> l) & 1;
}
#if OWN_STATE
for (int l = 0; l < (k.reached.shape[1] ? count : 0); ++l) {  // where worlds that have their own start end
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
