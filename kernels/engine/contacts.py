# SPDX-License-Identifier: Apache-2.0
"""Solver contacts → net force per watched pair."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def mujoco_contact_force_kernel(
    # inputs
    sensor: wp.array3d[wp.float64],  # [W, N, n] what all sensors show
    start: wp.array[int],  # [pair + 1] first number of each pair: net forces on its second side, to be summed
    end: wp.array[int],  # [T] last physics step of each control step
    first: int,  # world of thread 0
    # outputs
    force: wp.array3d[wp.vec3],  # [T, W, pair] [N] on the pair's first side, world frame, mean over the physics steps
):
    """One thread: the net contact force of every watched pair in one world, at all control steps."""
    w = first + wp.tid()
    begin = int(0)
    for t in range(end.shape[0]):
        for p in range(force.shape[2]):
            total = wp.vec3(0.0)
            for n in range(begin, end[t] + 1):
                for i in range(start[p], start[p + 1], 3):
                    total -= wp.vec3(float(sensor[w, n, i]), float(sensor[w, n, i + 1]), float(sensor[w, n, i + 2]))
            force[t, w, p] = total / float(end[t] + 1 - begin)
        begin = end[t] + 1


vec5 = wp.types.vector(length=5, dtype=float)


@wp.struct
class PairTable:
    """The watched pairs of one world, as entities, and which entity each shape belongs to."""

    shape_entity: wp.array[int]  # [ns] shapes (or MuJoCo geoms) of one world, -1 for none
    first: wp.array[int]  # [pair]
    second: wp.array[int]  # [pair]


@wp.func
def add_pair_force(pairs: PairTable, a: int, b: int, on_a: wp.vec3, t: int, w: int, force: wp.array3d[wp.vec3]):
    """Add the force on entity a from entity b to every pair that watches the two."""
    for p in range(pairs.first.shape[0]):
        if pairs.first[p] == a and pairs.second[p] == b:
            wp.atomic_add(force, t, w, p, on_a)
        elif pairs.first[p] == b and pairs.second[p] == a:
            wp.atomic_add(force, t, w, p, -on_a)


@wp.func
def row_force(efc_force: wp.array2d[float], w: int, row: int) -> float:
    """Force of one constraint row; rows beyond the solver's capacity were dropped and carry none."""
    if row < 0 or row >= efc_force.shape[1]:
        return 0.0
    return efc_force[w, row]


@wp.kernel
def mujoco_warp_contact_force_kernel(
    # inputs
    pairs: PairTable,
    elliptic: int,
    contact_count: wp.array[int],  # [1]
    contact_world: wp.array[int],  # [contact]
    contact_geom: wp.array[wp.vec2i],  # [contact]
    contact_dim: wp.array[int],  # [contact]
    contact_frame: wp.array[wp.mat33],  # [contact] rows: normal from first to second geom, two tangents
    contact_friction: wp.array[vec5],  # [contact]
    contact_row: wp.array2d[int],  # [contact, 10] constraint rows
    efc_force: wp.array2d[float],  # [W, njmax]
    step_overflow: wp.array[int],  # [W] overflow bits of the last physics step
    capacity_bits: int,  # those that stand for lost contacts or rows
    t: int,
    share: float,  # of one physics step in the mean over a control step
    # outputs
    force: wp.array3d[wp.vec3],  # [T, W, pair] [N] on the pair's first side, world frame
    overflow: wp.array[int],  # [W] capacity bits of all steps so far
):
    """One thread: the share of one contact in the force of its pair, or one world's capacity bits, or both."""
    i = wp.tid()
    if i < overflow.shape[0]:
        overflow[i] = overflow[i] | (step_overflow[i] & capacity_bits)
    if i >= contact_count[0] or i >= contact_world.shape[0]:
        return
    a = pairs.shape_entity[contact_geom[i][0]]
    b = pairs.shape_entity[contact_geom[i][1]]
    w = contact_world[i]
    dim = contact_dim[i]
    local = wp.vec3(0.0)
    if elliptic != 0 or dim == 1:
        for k in range(wp.min(dim, 3)):
            local[k] = row_force(efc_force, w, contact_row[i, k])
    else:
        # a pyramid's edges come in pairs: their sum pushes along the normal, their difference along the tangent
        first = contact_row[i, 0]
        for k in range(dim - 1):
            plus = row_force(efc_force, w, first + 2 * k)
            minus = row_force(efc_force, w, first + 2 * k + 1)
            if first < 0:
                plus = 0.0
                minus = 0.0
            local[0] += plus + minus
            if k < 2:
                local[k + 1] = (plus - minus) * contact_friction[i][k]
    on_second = wp.transpose(contact_frame[i]) * local
    add_pair_force(pairs, a, b, -share * on_second, t, w, force)


@wp.kernel
def newton_contact_force_kernel(
    # inputs
    pairs: PairTable,
    shapes: int,  # per world
    contact_count: wp.array[int],  # [1]
    contact_shape0: wp.array[int],  # [contact]
    contact_shape1: wp.array[int],  # [contact]
    contact_force: wp.array[wp.spatial_vector],  # [contact] wrench on the first shape; empty where none is watched
    step_overflow: wp.array[int],  # [W] overflow bits of the last physics step; empty where the solver has none
    capacity_bits: int,  # those that stand for lost contacts or rows
    pipeline_bit: int,
    t: int,
    share: float,  # of one physics step in the mean over a control step
    # outputs
    force: wp.array3d[wp.vec3],  # [T, W, pair] [N] on the pair's first side, world frame
    overflow: wp.array[int],  # [W]
):
    """One thread: the share of one contact in the force of its pair, or one world's capacity bits, or both.

    World 0 answers for contacts beyond the room of Newton's collision pipeline.
    """
    i = wp.tid()
    if i < step_overflow.shape[0]:
        overflow[i] = overflow[i] | (step_overflow[i] & capacity_bits)
    if i >= contact_force.shape[0]:
        return
    if i == 0 and contact_count[0] > contact_shape0.shape[0]:
        overflow[0] = overflow[0] | pipeline_bit
    if i >= contact_count[0]:
        return
    first = contact_shape0[i]
    second = contact_shape1[i]
    if first < 0 or second < 0:
        return
    a = pairs.shape_entity[first % shapes]
    b = pairs.shape_entity[second % shapes]
    add_pair_force(pairs, a, b, share * wp.spatial_top(contact_force[i]), t, first // shapes, force)
