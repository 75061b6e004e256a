// SPDX-License-Identifier: Apache-2.0
// The state after a control as slice h + 1 of the record, and what led there; the observed one as slice 0.
{
    const size_t records = k.record_q.shape[1], slice = (size_t)(h + 1) * records + row;
    float* const to_q = (float*)k.record_q.data + slice * k.record_q.shape[2];
    float* const to_v = (float*)k.record_qd.data + slice * k.record_qd.shape[2];
#if PLAIN
    EACH(i, NQ) PUT(to_q, NQ, i, w.q[i])
    EACH(i, NV) PUT(to_v, NV, i, w.v[i])
#if ACTS
    float* const to_act = (float*)k.record_act.data + slice * ACTS;
    EACH(i, ACTS) PUT(to_act, ACTS, i, w.act[i])
#endif
#else
#if ACTIVATIONS
    float* const to_act = (float*)k.record_act.data + slice * ACTIVATIONS;
    EACH(i, ACTIVATIONS) PUT(to_act, ACTIVATIONS, i, w.act[act_of[i]])
#endif
    const int nq = k.record_q.shape[2], nv = k.record_qd.shape[2];
#if !OWN_STATE
    if (h < 0) {
        EACH(i, nq) PUT(to_q, nq, i, (T)observed_q[i])
        EACH(i, nv) PUT(to_v, nv, i, (T)observed_v[i])
    } else
#endif
    {
        EACH(i, COORDINATES) PUT(to_q, nq, layout_q[i], w.q[model_q[i]])
        EACH(i, SPEEDS) PUT(to_v, nv, layout_v[i], w.v[model_v[i]])
#if TURNS
        EACH(i, TURNS) {
            T q[7], v[6];
            Sim::tell_joint(w, i, q, v);
            for (int n = 0; n < (turn_ball[i] ? 4 : 7); ++n) PUT(to_q, nq, turn_q[i] + n, q[n])
            for (int n = 0; n < (turn_ball[i] ? 3 : 6); ++n) PUT(to_v, nv, turn_v[i] + n, v[n])
        }
#endif
    }
    float* const to_pose = (float*)k.record_body_q.data + slice * 7 * BODIES;
    float* const to_twist = (float*)k.record_body_qd.data + slice * 6 * BODIES;
    EACH(b, BODIES) {
        const int r = body_row[b];
        T turn[4];
        Sim::quaternion(w.bmat[r], turn[0], turn[1], turn[2], turn[3]);
        for (int n = 0; n < 3; ++n) PUT(to_pose, 7 * BODIES, 7 * b + n, w.bpos[r][n])
        for (int n = 0; n < 4; ++n) PUT(to_pose, 7 * BODIES, 7 * b + 3 + n, turn[n])
        const Sim::V3 v = Sim::centre_velocity(w, r, w.blin[r], body_centre + 3 * b);
        PUT(to_twist, 6 * BODIES, 6 * b, v.x)
        PUT(to_twist, 6 * BODIES, 6 * b + 1, v.y)
        PUT(to_twist, 6 * BODIES, 6 * b + 2, v.z)
        for (int n = 0; n < 3; ++n) PUT(to_twist, 6 * BODIES, 6 * b + 3 + n, w.bang[r][n])
    }
    if (h >= 0) {
        float* const to = (float*)k.control.data + ((size_t)h * records + row) * controls;
        EACH(i, controls) PUT(to, controls, i, w.c[i])
#if WATCHED
        float* const to_force = (float*)k.force.data + ((size_t)h * records + row) * 3 * WATCHED;
        EACH(i, 3 * WATCHED) PUT(to_force, 3 * WATCHED, i, w.pushed[i])
#endif
#if READINGS
        const int sensors = k.sensor.shape[2];
        float* const to_sensor = (float*)k.sensor.data + ((size_t)h * records + row) * sensors;
        EACH(i, READINGS) PUT(to_sensor, sensors, shown_of[i], shown[i])
#endif
    }
#endif
}
