# SPDX-License-Identifier: Apache-2.0
"""Random physical properties: scale factors and offsets, one row per draw.

A draw depends on the seed, its row and ``first_item`` + its column only: more rows or more items leave it as it was.
Quantities that must vary independently (mass, friction, size) take different seeds or ranges of items.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# P(|z| < 3) of a standard normal: the range of erf within three standard deviations
ERF_THREE_SIGMA = wp.constant(0.9973002)


@wp.kernel
def uniform_scale_kernel(
    # inputs
    spread: wp.array[float],  # [items] half-width p, a fraction of nominal, below 1
    seed: int,
    first_item: int,
    nominal_first: int,
    # outputs
    scale: wp.array2d[float],  # [N, items] uniform in [1 - p, 1 + p]
):
    """Draw the factor of one item in one draw; with ``nominal_first`` draw 0 is nominal, factor 1."""
    n, i = wp.tid()

    row = wp.rand_init(seed, n)
    state = wp.rand_init(wp.randi(row), first_item + i)
    factor = 1.0 + spread[i] * wp.randf(state, -1.0, 1.0)
    scale[n, i] = wp.where(n == 0 and nominal_first != 0, 1.0, factor)


@wp.kernel
def normal_offset_kernel(
    # inputs
    sigma: wp.array[float],  # [items] standard deviation before truncation [m]
    seed: int,
    first_item: int,
    nominal_first: int,
    # outputs
    offset: wp.array3d[float],  # [N, items, 3] zero mean, within ±3σ [m]
):
    """Draw the offset of one item in one draw, each axis a Gaussian truncated at 3σ by its inverse distribution."""
    n, i = wp.tid()

    row = wp.rand_init(seed, n)
    state = wp.rand_init(wp.randi(row), first_item + i)
    for axis in range(3):
        z = wp.sqrt(2.0) * wp.erfinv(ERF_THREE_SIGMA * wp.randf(state, -1.0, 1.0))
        offset[n, i, axis] = wp.where(n == 0 and nominal_first != 0, 0.0, sigma[i] * z)


BOX = wp.constant(0)
SPHERE = wp.constant(1)
CAPSULE = wp.constant(2)
CYLINDER = wp.constant(3)
NO_RESIZE = wp.constant(-1)

LEAST_SIZE = wp.constant(0.1)  # no dimension shrinks below this share of its nominal value


@wp.func
def unit_inertia(kind: int, size: wp.vec3) -> wp.vec3:
    """Principal inertia per mass [m²] of a solid primitive about its own axes; half extents, or radius and half."""
    x = size[0]
    y = size[1]
    z = size[2]
    if kind == BOX:
        return wp.vec3(y * y + z * z, x * x + z * z, x * x + y * y) / 3.0
    if kind == SPHERE:
        return wp.vec3(0.4 * x * x)
    length = 2.0 * y
    if kind == CAPSULE:
        caps = 4.0 * x / (4.0 * x + 3.0 * length)  # share of the mass
        across = (1.0 - caps) * (3.0 * x * x + length * length) / 12.0
        across += caps * (0.4 * x * x + length * (3.0 * x + 2.0 * length) / 8.0)
        return wp.vec3(across, across, (0.5 * (1.0 - caps) + 0.4 * caps) * x * x)
    across = x * x / 4.0 + y * y / 3.0
    return wp.vec3(across, across, x * x / 2.0)


@wp.func
def resized(kind: int, size: wp.vec3, offset: wp.vec3) -> wp.vec3:
    """A primitive's size with ``offset`` [m] added to its full dimensions (a radius takes its offset as it is)."""
    out = size
    if kind == BOX:
        for k in range(3):
            out[k] = wp.max(size[k] + 0.5 * offset[k], LEAST_SIZE * size[k])
    else:
        out[0] = wp.max(size[0] + offset[0], LEAST_SIZE * size[0])
        if kind != SPHERE:
            out[1] = wp.max(size[1] + 0.5 * offset[1], LEAST_SIZE * size[1])
    return out


@wp.kernel
def apply_properties_kernel(
    # inputs
    draw: wp.array[int],  # [W] draw of each world
    mass_factor: wp.array2d[float],  # [N, items]
    friction_factor: wp.array2d[float],  # [N, items]
    size_offset: wp.array2d[wp.vec3],  # [N, items] [m]
    body_item: wp.array[int],  # [nb] randomized item of each body of one world, -1 for none
    shape_item: wp.array[int],  # [ns] randomized item of each shape of one world, -1 for none
    shape_body: wp.array[int],  # [ns] body in its own world, -1 for the world itself
    shape_kind: wp.array[int],  # [ns] primitive, or NO_RESIZE
    shape_pose: wp.array[wp.transform],  # [ns] in the body's frame
    nominal_mass: wp.array[float],  # [nb]
    nominal_inertia: wp.array[wp.mat33],  # [nb]
    nominal_friction: wp.array[float],  # [ns]
    nominal_size: wp.array[wp.vec3],  # [ns]
    # outputs
    mass: wp.array2d[float],  # [W, nb]
    inverse_mass: wp.array2d[float],  # [W, nb]
    inertia: wp.array2d[wp.mat33],  # [W, nb]
    inverse_inertia: wp.array2d[wp.mat33],  # [W, nb]
    friction: wp.array2d[float],  # [W, ns]
    size: wp.array2d[wp.vec3],  # [W, ns]
):
    """One thread: one world's mass, inertia, friction and sizes from its draw; inertia follows mass and size."""
    w = wp.tid()
    n = draw[w]
    for b in range(nominal_mass.shape[0]):
        if body_item[b] >= 0:
            factor = mass_factor[n, body_item[b]]
            mass[w, b] = factor * nominal_mass[b]
            inertia[w, b] = factor * nominal_inertia[b]
    for s in range(nominal_friction.shape[0]):
        item = shape_item[s]
        if item < 0:
            continue
        friction[w, s] = friction_factor[n, item] * nominal_friction[s]
        if shape_kind[s] == NO_RESIZE:
            continue
        new = resized(shape_kind[s], nominal_size[s], size_offset[n, item])
        size[w, s] = new
        b = shape_body[s]
        if b >= 0:
            # the ratio of new to old holds along the shape's own axes
            before = unit_inertia(shape_kind[s], nominal_size[s])
            after = unit_inertia(shape_kind[s], new)
            axes = wp.quat_to_matrix(wp.transform_get_rotation(shape_pose[s]))
            local = wp.transpose(axes) * inertia[w, b] * axes
            for i in range(3):
                for j in range(3):
                    local[i, j] = local[i, j] * wp.sqrt(after[i] / before[i] * after[j] / before[j])
            inertia[w, b] = axes * local * wp.transpose(axes)
    for b in range(nominal_mass.shape[0]):
        if body_item[b] >= 0 and mass[w, b] > 0.0:
            inverse_mass[w, b] = 1.0 / mass[w, b]
            inverse_inertia[w, b] = wp.inverse(inertia[w, b])
