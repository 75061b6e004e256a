# SPDX-License-Identifier: Apache-2.0
"""From uniform points or a counter to standard normals; what plans start from."""

import warp as wp

wp.set_module_options({"enable_backward": False})

# separates the stream of table rotations from the stream of pseudo-random normals
SHIFT_STREAM = wp.constant(0x5EED)


@wp.func
def inverse_normal_cdf(u: float) -> float:
    """Φ⁻¹(u), finite for every u: the argument is kept 2⁻²⁴ away from 0 and 1."""
    p = wp.clamp(u, 5.9604645e-8, 0.99999994)
    # erfcinv of the nearer tail: 2p - 1 would cancel the digits that decide the tails
    z = wp.sqrt(2.0) * wp.erfcinv(2.0 * wp.min(p, 1.0 - p))
    return wp.where(p < 0.5, -z, z)


@wp.kernel
def advance_counter_kernel(
    # inputs
    observed: wp.array[int],  # [E] whether there is an observation to plan from
    # outputs
    counter: wp.array[int],  # [E] draws made so far
):
    """Count one draw of one environment, on the device, so that a replayed CUDA graph draws anew.

    An environment without an observation to plan from draws nothing: it goes on later as if it had waited.
    """
    e = wp.tid()
    counter[e] = counter[e] + wp.where(observed[e] != 0, 1, 0)


@wp.kernel
def random_shift_kernel(
    # inputs
    counter: wp.array[int],  # [E] draws made so far
    seed: int,
    # outputs
    shift: wp.array2d[float],  # [E, P·nu] uniform in [0, 1)
):
    """Draw the rotation of one table column for one environment (Cranley and Patterson 1976)."""
    e, column = wp.tid()

    stream = wp.rand_init(seed ^ SHIFT_STREAM, counter[e])
    state = wp.rand_init(wp.randi(stream), e * shift.shape[1] + column)
    shift[e, column] = wp.randf(state)


@wp.kernel
def table_normal_kernel(
    # inputs
    table: wp.array2d[float],  # [S, P·nu] low-discrepancy points in [0, 1)
    shift: wp.array2d[float],  # [E, P·nu] rotation of the table, zero for the table itself
    first: int,  # row e·S + s of thread 0
    # outputs
    z: wp.array4d[float],  # [E, S, P, nu] standard normals
):
    """Turn one table entry into one standard normal, z = Φ⁻¹(frac(x + shift))."""
    row, p, u = wp.tid()
    e = (first + row) // z.shape[1]
    s = (first + row) % z.shape[1]

    column = p * z.shape[3] + u
    x = table[s, column] + shift[e, column]
    z[e, s, p, u] = inverse_normal_cdf(x - wp.floor(x))


@wp.kernel
def started_normal_kernel(
    # inputs
    normal: wp.array2d[float],  # [S, P·nu] standard normals of the table
    shift: wp.array2d[float],  # [E, P·nu] where each column starts, as a share of its length
    columns: int,  # that are drawn
    first: int,  # row e·S + s of thread 0
    lanes: int,  # threads that share the columns of a row
    # outputs
    z: wp.array3d[float],  # [E, S, P·nu] standard normals
):
    """One thread: some columns of one sample, each read from its own start on (Wang and Hickernell 2000)."""
    row, lane = wp.tid()
    samples = normal.shape[0]
    e = (first + row) // samples
    s = (first + row) % samples

    for column in range(lane, columns, lanes):
        from_start = s + int(shift[e, column] * float(samples))
        z[e, s, column] = normal[wp.where(from_start < samples, from_start, from_start - samples), column]


@wp.kernel
def random_normal_kernel(
    # inputs
    counter: wp.array[int],  # [E] draws made so far
    seed: int,
    first: int,  # row e·S + s of thread 0
    # outputs
    z: wp.array4d[float],  # [E, S, P, nu] standard normals
):
    """Draw one pseudo-random standard normal from the seed, the counter and its own index."""
    row, p, u = wp.tid()
    e = (first + row) // z.shape[1]
    s = (first + row) % z.shape[1]

    index = ((e * z.shape[1] + s) * z.shape[2] + p) * z.shape[3] + u
    stream = wp.rand_init(seed, counter[e])
    state = wp.rand_init(wp.randi(stream), index)
    z[e, s, p, u] = wp.randn(state)


@wp.kernel
def scale_samples_kernel(
    # inputs
    low: float,
    high: float,
    first: int,  # row e·S + s of thread 0
    # outputs
    z: wp.array4d[float],  # [E, S, P, nu] scaled in place
):
    """Scale one sample: they grow geometrically from ``low`` to ``high``, to search near and far at once."""
    row = first + wp.tid()
    e = row // z.shape[1]
    s = row % z.shape[1]

    share = float(s) / wp.max(float(z.shape[1] - 1), 1.0)
    growth = wp.pow(high / low, share)
    for p in range(z.shape[2]):
        for u in range(z.shape[3]):
            z[e, s, p, u] = z[e, s, p, u] * low * growth


@wp.kernel
def start_plan_kernel(
    # inputs
    observed: wp.array[int],  # [E]
    fresh: wp.array[int],  # [E] whether nothing has been planned yet
    joint_q: wp.array2d[float],  # [E, nq] observed
    held: wp.array[int],  # [nu] joint coordinate whose position asks for nothing, -1 for controls with a fixed value
    rest: wp.array[float],  # [nu] that value: zero speed or force, unless the scene starts with another
    lower: wp.array[float],  # [nu]
    upper: wp.array[float],  # [nu]
    # outputs
    null: wp.array2d[float],  # [E, nu] control that asks for nothing, within the limits
    mean: wp.array3d[float],  # [E, P, nu]
    last_control: wp.array2d[float],  # [E, nu]
):
    """One thread: one control of one environment that asks for nothing: stay where you are, or no effort.

    A first plan begins with it, where the environment is observed.
    """
    e, u = wp.tid()
    value = rest[u]
    if held[u] >= 0:
        value = joint_q[e, held[u]]
    value = wp.clamp(value, lower[u], upper[u])
    null[e, u] = value
    if fresh[e] == 0 or observed[e] == 0:
        return
    for p in range(mean.shape[1]):
        mean[e, p, u] = value
    last_control[e, u] = value


@wp.kernel
def age_plan_kernel(
    # inputs
    observed: wp.array[int],  # [E]
    # outputs
    fresh: wp.array[int],  # [E]
):
    """One thread: an environment that was observed has a plan from now on."""
    e = wp.tid()
    if observed[e] != 0:
        fresh[e] = 0
