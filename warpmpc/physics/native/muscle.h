// SPDX-License-Identifier: Apache-2.0
// Muscles: active and passive forces, and how fast they are activated (MuJoCo, "Modeling: Muscles").
#if MUSCLES
INLINE T muscle_length(T length, T start, T over, T first) { return first + (length - start) * over; }
// Force of full activation, and its derivative by velocity. Lengths are over the optimum's, velocities over the largest
// (fast: the inverse).
FN T muscle_gain(T length, T speed, T start, T over, T first, T least, T most, T fast, T top, T force, T& slope) {
    const T l = muscle_length(length, start, over, first), v = speed * fast, tiny = splat(1e-15f), one = splat(1.0f);
    const T away = VABS(l - 1.0f) / VMAX(0.5f * (l <= 1.0f ? one - least : most - 1.0f), tiny), rest = VMAX(2.0f - away, zero());
    const T reach = away <= 1.0f ? 1.0f - 0.5f * away * away : 0.5f * rest * rest;
    const T y = top - 1.0f, slower = VMAX(v + 1.0f, zero()), below = VMAX(y - v, zero()), scale = 1.0f / VMAX(y, tiny);
    const I shortens = v <= 0.0f;
    slope = -force * reach * fast * (shortens ? 2.0f * slower : 2.0f * below * scale);
    return -force * reach * (shortens ? slower * slower : top - below * below * scale);
}
// Force without activation
FN T muscle_bias(T length, T start, T over, T first, T most, T force) {
    const T half = 0.5f * (most - 1.0f), x = (muscle_length(length, start, over, first) - 1.0f) / VMAX(half, splat(1e-15f));
    const T stretched = VMAX(x, zero());
    return -force * (stretched <= 1.0f ? 0.5f * stretched * stretched : stretched - 0.5f);
}
// Derivative of the activation by time (Millard et al. 2013)
FN T muscle_rate(T control, T act, float rising, float falling, float width) {
    const T held = VMIN(VMAX(act, zero()), splat(1.0f)), more = VMIN(VMAX(control, zero()), splat(1.0f)) - act;
    const T up = rising * (0.5f + 1.5f * held), down = falling / (0.5f + 1.5f * held);
    const T x = width < 1e-15f ? (more > 0.0f ? splat(1.0f) : zero()) : VMIN(VMAX(more / width + 0.5f, zero()), splat(1.0f));
    const T share = width < 1e-15f ? x : x * x * x * (3.0f * x * (2.0f * x - 5.0f) + 10.0f);
    return more / VMAX(down + (up - down) * share, splat(1e-15f));
}
#endif
