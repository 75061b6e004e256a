# SPDX-License-Identifier: Apache-2.0
"""Random physical properties, drawn and put into the numbers of a MuJoCo model, one row per draw.

A draw depends on the seed, its number and its item alone: more draws or more items leave it as it was. Draws go on
counting from plan to plan where they are drawn anew.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# P(|z| < 3) of a standard normal: the range of erf within three standard deviations
ERF_THREE_SIGMA = wp.constant(0.9973002)
# no dimension shrinks below this share of its nominal value
LEAST_SIZE = wp.constant(wp.float64(0.1))
# bound of a contact's coefficients of friction
LEAST_FRICTION = wp.constant(wp.float64(1e-5))
BOX = wp.constant(1)
ELLIPSOID = wp.constant(2)
SPHERE = wp.constant(3)
CAPSULE = wp.constant(4)
CYLINDER = wp.constant(5)
FRICTION_COLUMN = wp.constant(1)
PYRAMID_COLUMN = wp.constant(2)


@wp.struct
class DrawRules:
    """Distributions of items' properties."""

    mass: wp.array[float]  # [items] half-width p, a fraction of nominal, below 1
    mass_ends: wp.array[int]  # [items] nonzero where it is off by all of p, up or down
    friction: wp.array[float]  # [items] likewise
    friction_ends: wp.array[int]
    size: wp.array[float]  # [items] standard deviation before truncation [m]
    redraw: wp.array[int]  # [items] nonzero where draws go on counting from plan to plan
    seed: int


@wp.struct
class Draws:
    """Factors and offsets, one row per draw."""

    mass: wp.array2d[wp.float64]  # [N, items]
    friction: wp.array2d[wp.float64]  # [N, items]
    size: wp.array3d[wp.float64]  # [N, items, 3] added to each dimension [m]


@wp.func
def uniform_factor(spread: float, ends: int, seed: int, n: int, i: int) -> wp.float64:
    """A factor that is uniform in [1 - spread, 1 + spread], or one of both ends."""
    row = wp.rand_init(seed, n)
    state = wp.rand_init(wp.randi(row), i)
    factor = wp.float64(1.0 + spread * wp.randf(state, -1.0, 1.0))
    one = wp.float64(1.0)
    end = wp.where(factor < one, -wp.float64(spread), wp.float64(spread))
    return wp.where(ends != 0, one + end, factor)


@wp.kernel
def draw_kernel(
    # inputs
    rules: DrawRules,
    first: wp.array[int],  # [1] number of the first draw
    # outputs
    out: Draws,
):
    """Draw the properties of one item in one draw: factors, and Gaussians truncated at 3σ by their inverse."""
    row, i = wp.tid()
    n = row + wp.where(rules.redraw[i] != 0, first[0], 0)

    out.mass[row, i] = uniform_factor(rules.mass[i], rules.mass_ends[i], rules.seed, n, i)
    out.friction[row, i] = uniform_factor(rules.friction[i], rules.friction_ends[i], rules.seed + 1, n, i)
    state = wp.rand_init(wp.randi(wp.rand_init(rules.seed + 2, n)), i)
    for axis in range(3):
        z = wp.sqrt(2.0) * wp.erfinv(ERF_THREE_SIGMA * wp.randf(state, -1.0, 1.0))
        out.size[row, i, axis] = wp.float64(rules.size[i] * z)


@wp.kernel
def count_kernel(
    # inputs
    draws: int,
    # outputs
    first: wp.array[int],  # [1]
):
    """Go on to the next draws."""
    first[0] = first[0] + draws


@wp.struct
class ModelTables:
    """Places of a MuJoCo model's numbers in its row, and what is drawn of it."""

    nominal: wp.array[wp.float64]  # [numbers]
    body_mass: int  # place of the first number of each array
    body_inertia: int
    body_subtreemass: int
    geom_friction: int
    geom_size: int
    geom_aabb: int
    geom_rbound: int
    pair_friction: int
    body_parent: wp.array[int]  # [nbody]
    bodies: wp.array2d[int]  # [n, 2] body, its item
    geoms: wp.array2d[int]  # [n, 4] geom, its item, kind where its size varies else 0, its body
    axes: wp.array2d[int]  # [nbody, 3] axis of the geometry that each principal axis lies along
    pairs: wp.array2d[int]  # [n, 3] pair whose friction is an average, its geoms
    damped: wp.array2d[int]  # [n, 2] place of a damping, and of the mass or moment of inertia that it is a multiple of


@wp.func
def unit_inertia(kind: int, s: wp.vec3d) -> wp.vec3d:
    """Principal inertia per mass of a solid primitive about its own axes [m²]."""
    x = s[0]
    y = s[1]
    z = s[2]
    if kind == BOX:
        return wp.vec3d(y * y + z * z, x * x + z * z, x * x + y * y) / wp.float64(3.0)
    if kind == ELLIPSOID:
        return wp.vec3d(y * y + z * z, x * x + z * z, x * x + y * y) / wp.float64(5.0)
    if kind == SPHERE:
        about = wp.float64(0.4) * x * x
        return wp.vec3d(about, about, about)
    if kind == CAPSULE:
        two = wp.float64(2.0)
        three = wp.float64(3.0)
        length = two * y
        caps = wp.float64(4.0) * x / (wp.float64(4.0) * x + three * length)  # share of the mass
        tube = wp.float64(1.0) - caps
        across = tube * (three * x * x + length * length) / wp.float64(12.0)
        across += caps * (wp.float64(0.4) * x * x + length * (three * x + two * length) / wp.float64(8.0))
        return wp.vec3d(across, across, (wp.float64(0.5) * tube + wp.float64(0.4) * caps) * x * x)
    side = x * x / wp.float64(4.0) + y * y / wp.float64(3.0)
    return wp.vec3d(side, side, x * x / wp.float64(2.0))


@wp.func
def resized(kind: int, s: wp.vec3d, offset: wp.vec3d) -> wp.vec3d:
    """Half extents, or radius and half length, with an offset of full extents, or of radius and length [m]."""
    half = wp.float64(0.5)
    out = s
    if kind == BOX or kind == ELLIPSOID:
        for k in range(3):
            out[k] = wp.max(s[k] + offset[k] * half, LEAST_SIZE * s[k])
        return out
    out[0] = wp.max(s[0] + offset[0], LEAST_SIZE * s[0])
    if kind != SPHERE:
        out[1] = wp.max(s[1] + offset[1] * half, LEAST_SIZE * s[1])
    return out


@wp.kernel
def apply_kernel(
    # inputs
    tables: ModelTables,
    draws: Draws,
    # outputs
    values: wp.array2d[wp.float64],  # [N, numbers]
):
    """Put one draw into its row: masses, inertia, friction, sizes with their bounds, averages of friction, damping."""
    n = wp.tid()

    for b in range(tables.bodies.shape[0]):
        body = tables.bodies[b, 0]
        factor = draws.mass[n, tables.bodies[b, 1]]
        values[n, tables.body_mass + body] = tables.nominal[tables.body_mass + body] * factor
        for k in range(3):
            at = tables.body_inertia + 3 * body + k
            values[n, at] = tables.nominal[at] * factor
        above = body
        while above > 0:
            values[n, tables.body_subtreemass + above] = tables.nominal[tables.body_subtreemass + above]
            above = tables.body_parent[above]
        values[n, tables.body_subtreemass] = tables.nominal[tables.body_subtreemass]
    for b in range(tables.bodies.shape[0]):
        above = tables.bodies[b, 0]
        more = values[n, tables.body_mass + above] - tables.nominal[tables.body_mass + above]
        while above > 0:
            values[n, tables.body_subtreemass + above] += more
            above = tables.body_parent[above]
        values[n, tables.body_subtreemass] += more

    for g in range(tables.geoms.shape[0]):
        geom = tables.geoms[g, 0]
        item = tables.geoms[g, 1]
        kind = tables.geoms[g, 2]
        body = tables.geoms[g, 3]
        at = tables.geom_friction + 3 * geom
        values[n, at] = tables.nominal[at] * draws.friction[n, item]
        if kind > 0:
            at = tables.geom_size + 3 * geom
            old = wp.vec3d(tables.nominal[at], tables.nominal[at + 1], tables.nominal[at + 2])
            offset = wp.vec3d(draws.size[n, item, 0], draws.size[n, item, 1], draws.size[n, item, 2])
            new = resized(kind, old, offset)
            now = unit_inertia(kind, new)
            was = unit_inertia(kind, old)
            half = new
            radius = wp.length(new)
            if kind == ELLIPSOID:
                radius = wp.max(new[0], wp.max(new[1], new[2]))
            elif kind == SPHERE:
                half = wp.vec3d(new[0], new[0], new[0])
                radius = new[0]
            elif kind == CAPSULE:
                half = wp.vec3d(new[0], new[0], new[0] + new[1])
                radius = new[0] + new[1]
            elif kind == CYLINDER:
                half = wp.vec3d(new[0], new[0], new[1])
                radius = wp.sqrt(new[0] * new[0] + new[1] * new[1])
            for k in range(3):
                values[n, at + k] = new[k]
                values[n, tables.geom_aabb + 6 * geom + 3 + k] = half[k]
                if body > 0:
                    axis = tables.axes[body, k]
                    values[n, tables.body_inertia + 3 * body + k] *= now[axis] / was[axis]
            values[n, tables.geom_rbound + geom] = radius

    for p in range(tables.pairs.shape[0]):
        first = tables.geom_friction + 3 * tables.pairs[p, 1]
        second = tables.geom_friction + 3 * tables.pairs[p, 2]
        mean = wp.float64(0.5) * (values[n, first] + values[n, second])
        at = tables.pair_friction + 5 * tables.pairs[p, 0]
        values[n, at] = mean
        values[n, at + 1] = mean

    for d in range(tables.damped.shape[0]):
        at = tables.damped[d, 0]
        of = tables.damped[d, 1]
        values[n, at] = tables.nominal[at] * values[n, of] / tables.nominal[of]


@wp.struct
class WeightTables:
    """Degrees of freedom whose mass matrix draws change, and what MuJoCo derives from its inverse at the reference."""

    matrix: wp.array2d[wp.float64]  # [n, n] nominal mass matrix
    numbers: wp.array[int]  # [m] masses and principal inertias that are drawn, by their places
    parts: wp.array3d[wp.float64]  # [m, n, n] what one unit of each adds to it
    rows: wp.array2d[wp.float64]  # [rows, n] directions r
    lengths: wp.array[int]  # [rows] nonzero where |M⁻¹r| is asked for, else rᵀM⁻¹r
    entry: wp.array[int]  # [rows + 1] first entry of each row
    target: wp.array[int]  # [entries] place that a share of a row's number is added to
    share: wp.array[wp.float64]  # [entries]


@wp.kernel
def weigh_kernel(
    # inputs
    nominal: wp.array[wp.float64],  # [numbers]
    tables: WeightTables,
    # outputs
    factor: wp.array3d[wp.float64],  # [N, n, n] Cholesky factor L
    solution: wp.array2d[wp.float64],  # [N, n]
    values: wp.array2d[wp.float64],  # [N, numbers]
):
    """Inverse weights of one draw's bodies, degrees of freedom and tendons, as ``mj_setConst`` has them."""
    w = wp.tid()
    n = tables.matrix.shape[0]
    zero = wp.float64(0.0)

    for i in range(n):
        for j in range(i + 1):
            entry = tables.matrix[i, j]
            for k in range(tables.numbers.shape[0]):
                at = tables.numbers[k]
                entry += (values[w, at] - nominal[at]) * tables.parts[k, i, j]
            for k in range(j):
                entry -= factor[w, i, k] * factor[w, j, k]
            if i == j:
                factor[w, i, j] = wp.sqrt(entry)
            else:
                factor[w, i, j] = entry / factor[w, j, j]
    for e in range(tables.target.shape[0]):
        values[w, tables.target[e]] = zero
    for r in range(tables.rows.shape[0]):
        total = wp.float64(0.0)
        for i in range(n):
            y = tables.rows[r, i]
            for j in range(i):
                y -= factor[w, i, j] * solution[w, j]
            y = y / factor[w, i, i]
            solution[w, i] = y
            total += y * y
        if tables.lengths[r] != 0:
            total = wp.float64(0.0)
            for back in range(n):
                i = n - 1 - back
                x = solution[w, i]
                for j in range(i + 1, n):
                    x -= factor[w, j, i] * solution[w, j]
                x = x / factor[w, i, i]
                solution[w, i] = x
                total += x * x
            total = wp.sqrt(total)
        for e in range(tables.entry[r], tables.entry[r + 1]):
            values[w, tables.target[e]] += tables.share[e] * total


@wp.kernel
def copy_numbers_kernel(
    # inputs
    values: wp.array2d[wp.float64],  # [N, numbers]
    draw: wp.array[int],  # [W] draw of each world
    first: int,
    # outputs
    out: wp.array2d[float],  # [W, n] numbers from the first on
):
    """Give one world one number of its draw, in single precision."""
    w, i = wp.tid()
    out[w, i] = float(values[draw[w], first + i])


@wp.func_native("*(double*)address = value;")
def put_number(address: wp.uint64, value: wp.float64):
    """Write a number to an address of this process."""
    ...


@wp.kernel
def put_numbers_kernel(
    # inputs
    values: wp.array2d[wp.float64],  # [N, numbers]
    place: wp.array[int],  # [n]
    address: wp.array2d[wp.uint64],  # [N, n] of these numbers in models of MuJoCo's C engine
):
    """Write the numbers of one draw into its model, in this process's memory."""
    n = wp.tid()
    for i in range(place.shape[0]):
        put_number(address[n, i], values[n, place[i]])


@wp.struct
class ColumnTables:
    """Recipes by which columns of the engine ``fused`` follow from the numbers of a model."""

    constant: wp.array[wp.float64]  # [columns]
    entry: wp.array[int]  # [columns + 1] first entry of each column
    place: wp.array[int]  # [entries] a number
    share: wp.array[wp.float64]  # [entries] what one unit of it adds
    kind: wp.array[int]  # [columns] 0: their sum, else of a contact
    friction: wp.array2d[int]  # [columns, 2] numbers whose larger is a contact's friction
    impratio: wp.float64


@wp.kernel
def column_kernel(
    # inputs
    tables: ColumnTables,
    values: wp.array2d[wp.float64],  # [N, numbers]
    draw: wp.array[int],  # [W]
    # outputs
    out: wp.array2d[float],  # [columns, W]
):
    """Write the column of one world; a pyramid's edges are all regularized by its friction (MuJoCo)."""
    c, w = wp.tid()
    n = draw[w]
    total = tables.constant[c]
    for e in range(tables.entry[c], tables.entry[c + 1]):
        total += tables.share[e] * values[n, tables.place[e]]
    if tables.kind[c] != 0:
        mu = wp.max(wp.max(values[n, tables.friction[c, 0]], values[n, tables.friction[c, 1]]), LEAST_FRICTION)
        square = mu * mu
        two = wp.float64(2.0)
        if tables.kind[c] == PYRAMID_COLUMN:
            total = two * square / tables.impratio * (wp.float64(1.0) + square) * total
        else:
            total = mu
    out[c, w] = float(total)
