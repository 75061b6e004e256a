// SPDX-License-Identifier: Apache-2.0
// Forces of the last step's contacts, added to those of the watched pairs of entities
#if WATCHED
INLINE V3 force_of(const Contact& c) {
    T f[PUSH];
    contact_force(c, f);
    const V3 normal = load(c.normal), along = load(c.tangent);
    return normal * f[0] + along * f[1] + cross(normal, along) * f[2];
}
FN void watch(World& w) {
#if COOPERATE
    EACH(n, w.contacts) {
        const V3 f = force_of(w.con[n]);
        w.con[n].push[0] = f.x, w.con[n].push[1] = f.y, w.con[n].push[2] = f.z;
    }
    SYNC
    EACH(i, 3 * WATCHED) {
        T sum = w.pushed[i];
        for (int n = 0; n < w.contacts; ++n) {
            const Contact& c = w.con[w.order[n]];
            if (group_watched[c.group]) sum += watch_sign[i / 3 * PAIRS + c.pair] * c.push[i % 3];
        }
        w.pushed[i] = sum;
    }
    SYNC
#else
    for (int n = 0; n < w.contacts; ++n) {
        const Contact& c = w.con[w.order[n]];
        if (!group_watched[c.group]) continue;
        const I here = c.weight > 0.0f, pair = here ? c.pair : (I)0;  // lanes that hold none have no pair either
        const V3 f = force_of(c);
        const T own[3] = {here ? f.x : zero(), here ? f.y : zero(), here ? f.z : zero()};
        for (int i = 0; i < WATCHED; ++i) {
            const T sign = VGATHER(watch_sign + i * PAIRS, pair);
            for (int k = 0; k < 3; ++k) w.pushed[3 * i + k] += sign * own[k];
        }
    }
#endif
}
#endif
