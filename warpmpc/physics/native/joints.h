// SPDX-License-Identifier: Apache-2.0
// Free and ball joints between the layout's convention, with anchors on both bodies and the velocity of the centre of
// mass, and the model's (MuJoCo, "Modelling: Joints").
struct Q4 { T x, y, z, s; };
INLINE Q4 times(Q4 a, Q4 b) {
    return {a.s * b.x + a.x * b.s + a.y * b.z - a.z * b.y, a.s * b.y - a.x * b.z + a.y * b.s + a.z * b.x,
            a.s * b.z + a.x * b.y - a.y * b.x + a.z * b.s, a.s * b.s - a.x * b.x - a.y * b.y - a.z * b.z};
}
INLINE Q4 back(Q4 q) { return {zero() - q.x, zero() - q.y, zero() - q.z, q.s}; }
INLINE V3 spun_by(Q4 q, V3 v) {
    const V3 u = {q.x, q.y, q.z}, t = cross(u, v);
    return v + (t * q.s + cross(u, t)) * splat(2.0f);
}
INLINE Q4 quaternion_at(const float* p) { return {splat(p[0]), splat(p[1]), splat(p[2]), splat(p[3])}; }
INLINE Q4 quaternion_of(const T* q) { return {q[1], q[2], q[3], q[0]}; }  // of the model
INLINE void put3(V3 v, T* to) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }
INLINE void put4(Q4 q, T* to) { to[0] = q.s, to[1] = q.x, to[2] = q.y, to[3] = q.z; }
#if TURNS
// Joint i from what was observed
FN void start_joint(World& w, int i, const float* q, const float* v) {
    const float *parent = turn_parent + 7 * i, *child = turn_child + 7 * i;
    const Q4 anchor = quaternion_at(child + 3);
    T *to = w.q + turn_model_q[i], *rate = w.v + turn_model_v[i];
    if (turn_ball[i]) {
        const Q4 r = quaternion_at(q);
        put4(times(times(anchor, r), back(anchor)), to);
        put3(spun_by(times(anchor, back(r)), vector(v)), rate);
        return;
    }
    const Q4 base = quaternion_at(parent + 3), r = times(times(base, quaternion_at(q + 3)), back(anchor));
    put3(vector(parent) + spun_by(base, vector(q)) - spun_by(r, vector(child)), to);
    put4(r, to + 3);
    const V3 omega = spun_by(base, vector(v + 3)), arm = spun_by(r, vector(body_centre + 3 * turn_body[i]));
    put3(spun_by(base, vector(v)) - cross(omega, arm), rate);
    put3(spun_by(back(r), omega), rate + 3);
}
// Its coordinates and velocities for the record
FN void tell_joint(const World& w, int i, T* q, T* v) {
    const float *parent = turn_parent + 7 * i, *child = turn_child + 7 * i;
    const Q4 anchor = quaternion_at(child + 3);
    const T *from = w.q + turn_model_q[i], *rate = w.v + turn_model_v[i];
    if (turn_ball[i]) {
        const Q4 r = times(times(back(anchor), quaternion_of(from)), anchor);
        q[0] = r.x, q[1] = r.y, q[2] = r.z, q[3] = r.s;
        put3(spun_by(times(r, back(anchor)), load(rate)), v);
        return;
    }
    const Q4 base = back(quaternion_at(parent + 3)), own = quaternion_of(from + 3), r = times(times(base, own), anchor);
    put3(spun_by(base, load(from) + spun_by(own, vector(child)) - vector(parent)), q);
    q[3] = r.x, q[4] = r.y, q[5] = r.z, q[6] = r.s;
    const int b = body_row[turn_body[i]];
    put3(spun_by(base, centre_velocity(w, b, rate, body_centre + 3 * turn_body[i])), v);
    put3(spun_by(base, load(w.bang[b])), v + 3);
}
#endif
