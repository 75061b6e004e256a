// SPDX-License-Identifier: Apache-2.0
// What sensors read within a step, once its forces are known (MuJoCo, "Computation: Sensors"); `sense` is baked.

#if SENSES_FORCES
// Accelerations of all lanes into w.x: those of lanes that nothing constrains the solver has not touched
INLINE void settle(World& w, I alone) {
    if (VANY(alone)) {
        free_accelerations(w);
        SYNC
        EACH(i, NV) w.x[i] = alone ? w.search[i] : w.x[i];
        SYNC
    }
}
// Force of the limit of a degree of freedom
INLINE T limit_force(const World& w, int dof) {
    T out = zero();
    for (int k = 0; k < w.limits; ++k)
        if (w.ldof[k] == dof) out += w.lweight[k] > 0.0f ? -w.lweight[k] * VMIN(w.la[k], zero()) : zero();
    return out;
}
#if CONSTRAINTS
// Force of a row of constraints
INLINE T constraint_force(const World& w, int k) {
    const T weight = w.constraint_weight[k];
    return weight > 0.0f ? -between(weight * w.constraint_a[k], constraint_low[k], constraint_high[k]) : zero();
}
#endif
#endif
// Energy of motion [J]
INLINE T kinetic(World& w) {
    multiply(w.mm, w.v, w.mv);
    SYNC
    T sum = zero();
    EACH(i, NV) sum += 0.5f * w.v[i] * w.mv[i];
    sum = total(sum);
    SYNC
    return sum;
}
#if SENSES_CONTACTS
// A contact in the lanes that hold one: force and torque along its normal and tangents, and in the world on the second
// geom
struct Seen {
    V3 point, normal, tangent, force, torque;
    T along[6], distance;
    I here, pair;
};
INLINE Seen seen(const World& w, const Contact& c) {
    Seen s;
    T f[PUSH];
    contact_force(c, f);
    s.here = c.weight > 0.0f;
    s.pair = s.here ? c.pair : (I)0;
    for (int i = 0; i < 6; ++i) s.along[i] = zero();
    for (int i = 0; i < PUSH; ++i) s.along[i] = s.here ? f[i] : zero();
    s.normal = load(c.normal), s.tangent = load(c.tangent), s.point = load(c.point);
    s.distance = c.distance;
    const V3 other = cross(s.normal, s.tangent), none = {zero(), zero(), zero()};
    s.force = choose(s.here, s.normal * s.along[0] + s.tangent * s.along[1] + other * s.along[2], none);
    s.torque = choose(s.here, s.normal * s.along[3] + s.tangent * s.along[4] + other * s.along[5], none);
    s.point = choose(s.here, s.point, none);
    return s;
}
INLINE void put(V3 v, T* to) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }
// Force of contacts on some bodies, and its torque about a point; sign of each pair: 1 where they have its second geom,
// -1 where its first
FN void contact_wrench(const World& w, const float* sign, V3 about, T* out) {
    V3 force = {zero(), zero(), zero()}, torque = force;
    for (int n = 0; n < w.contacts; ++n) {
        const Seen s = seen(w, w.con[w.order[n]]);
        const T side = s.here ? VGATHER(sign, s.pair) : zero();
        force = force + s.force * side;
        torque = torque + (s.torque + cross(s.point - about, s.force)) * side;
    }
    put(force, out), put(torque, out + 3);
}
// Normal forces of contacts of a body whose line of force meets a shape around a site
FN T touch(const World& w, const float* sign, int kind, const float* size, const T* at, const T* turn) {
    T out = zero();
    for (int n = 0; n < w.contacts; ++n) {
        const Seen s = seen(w, w.con[w.order[n]]);
        const T side = s.here ? VGATHER(sign, s.pair) : zero();
        const V3 from = choose(s.here, s.point - load(at), {zero(), zero(), zero()});
        const V3 d = choose(s.here, s.normal * side, {zero(), zero(), splat(1.0f)});
        const T met = ray_shape(kind, along_axes(turn, from), along_axes(turn, d), vector(size));
        out += (s.here & (side * side > 0.0f) & (s.along[0] > 0.0f) & (met >= 0.0f)) ? s.along[0] : zero();
    }
    return out;
}
// What a sensor of contacts tells: of some contacts, or of the sum of all. sign of each pair as the sensor's objects have
// it, 0 for those of others; rank: MuJoCo's order of pairs; spec: fields, as bits
FN void tell_contacts(World& w, const float* sign, const float* rank, int site, int kind, const float* size, int spec,
                      int reduce, int slots, T* to) {
    T found = zero(), weight = zero(), side[CAPACITY], by[CAPACITY];
    I match[CAPACITY];
    V3 centre = {zero(), zero(), zero()}, force = centre, torque = centre;
    for (int n = 0; n < w.contacts; ++n) {
        const Seen s = seen(w, w.con[w.order[n]]);
        side[n] = s.here ? VGATHER(sign, s.pair) : zero();
        match[n] = side[n] * side[n] > 0.0f;
#if SITES
        if (site >= 0) match[n] &= inside(kind, along_axes(w.site_turn[site], s.point - load(w.site_at[site])), vector(size));
#endif
        T square = zero();
        for (int i = 0; i < 6; ++i) square += s.along[i] * s.along[i];
        by[n] = reduce == 1 ? s.distance : reduce == 2 ? -square : VGATHER(rank, s.pair);
        found += match[n] ? splat(1.0f) : zero();
        const T strength = match[n] ? VSQRT(dot(s.force, s.force)) : zero();
        weight += strength;
        centre = centre + s.point * strength;
        force = force + s.force * (match[n] ? side[n] : zero());
    }
    if (reduce == 3) {
        centre = centre * (1.0f / VMAX(weight, splat(1e-15f)));
        for (int n = 0; n < w.contacts; ++n) {
            const Seen s = seen(w, w.con[w.order[n]]);
            torque = torque + (s.torque + cross(s.point - centre, s.force)) * (match[n] ? side[n] : zero());
        }
        const T one = found > 0.0f ? splat(1.0f) : zero();
        const V3 x = {one, zero(), zero()}, y = {zero(), one, zero()};
        const V3 fields[5] = {force, torque, centre, x, y};
        if (spec & 1) *to++ = found;
        for (int k = 0; k < 6; ++k) {
            if (!(spec & 2 << k)) continue;
            if (k == 2) *to++ = zero();
            else put(fields[k > 2 ? k - 1 : k], to), to += 3;
        }
        return;
    }
    for (int slot = 0; slot < slots; ++slot) {
        T best = splat(1e30f);
        I chosen = (I)-1;
        for (int n = 0; n < w.contacts; ++n) {
            const I better = match[n] & (by[n] < best);
            best = better ? by[n] : best;
            chosen = better ? (I)n : chosen;
        }
        V3 fields[5] = {{zero(), zero(), zero()}};
        for (int k = 0; k < 5; ++k) fields[k] = {zero(), zero(), zero()};
        T distance = zero();
        I any = NO;
        for (int n = 0; n < w.contacts; ++n) {
            const I own = match[n] & (chosen == (I)n);
            if (!VANY(own)) continue;
            match[n] &= VNOT(own);
            any |= own;
            const Seen s = seen(w, w.con[w.order[n]]);
            const V3 f = {s.along[0], s.along[1], s.along[2] * side[n]}, t = {s.along[3], s.along[4], s.along[5] * side[n]};
            const V3 all[5] = {f, t, s.point, s.normal * side[n], s.tangent * side[n]};
            for (int k = 0; k < 5; ++k) fields[k] = choose(own, all[k], fields[k]);
            distance = own ? s.distance : distance;
        }
        if (spec & 1) *to++ = any ? found : zero();
        for (int k = 0; k < 6; ++k) {
            if (!(spec & 2 << k)) continue;
            if (k == 2) *to++ = distance;
            else put(fields[k > 2 ? k - 1 : k], to), to += 3;
        }
    }
}
#endif
