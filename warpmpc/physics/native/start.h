// SPDX-License-Identifier: Apache-2.0
// The state that worlds start in: what was observed of their environment, as the model keeps it, or its own state.
#if OWN_STATE
for (int l = 0; l < lanes; ++l) {  // each world has its own start: time, coordinates, velocities
    const double* initial = (const double*)k.initial.data + (size_t)world[l] * k.initial.shape[1] + 1;
    EACH(i, NQ) LANE(w.q[i], l) = (float)initial[i];
    EACH(i, NV) LANE(w.v[i], l) = (float)initial[NQ + i];
#if ACTS
    EACH(i, ACTS) LANE(w.act[i], l) = (float)initial[NQ + NV + i];
#endif
}
#else
const float* observed_q = (const float*)k.joint_q.data + e * k.joint_q.shape[1];
const float* observed_v = (const float*)k.joint_qd.data + e * k.joint_qd.shape[1];
EACH(i, COORDINATES) w.q[model_q[i]] = (T)observed_q[layout_q[i]];
EACH(i, SPEEDS) w.v[model_v[i]] = (T)observed_v[layout_v[i]];
#if TURNS
EACH(i, TURNS) Sim::start_joint(w, i, observed_q + turn_q[i], observed_v + turn_v[i]);
#endif
#if ACTIVATIONS
EACH(i, ACTIVATIONS) w.act[act_of[i]] = (T)k.act.data[e * ACTIVATIONS + i];
#endif
#endif
EACH(i, 7 * NMOCAP) w.mocap[i] = (T)mocap_rest[i];
#if !PLAIN
SYNC
const float* poses[2] = {(const float*)k.mocap.data + 7 * e * k.mocap.shape[1],
                         (const float*)k.pose.data + 7 * ((e + 1) * k.pose.shape[1] - MOVABLES)};
EACH(i, 7 * MOCAPS) w.mocap[7 * mocap_of[i / 7] + quaternion_order[i % 7]] = (T)poses[0][i];
EACH(i, 7 * MOVABLES) w.mocap[7 * movable_of[i / 7] + quaternion_order[i % 7]] = (T)poses[1][i];
#endif
EACH(i, PARAMETERS)
    for (int l = 0; l < lanes; ++l) LANE(w.par[i], l) = k.par.data[(size_t)i * worlds + world[l]];
EACH(i, NV) w.x[i] = (T)0.0f;
EACH(i, NCONTROL) w.c[i] = (T)0.0f;
#if WATCHED
EACH(i, 3 * WATCHED) w.pushed[i] = (T)0.0f;
#endif
w.given = (const float*)k.given.data;
w.overflow = 0;
