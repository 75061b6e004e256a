# SPDX-License-Identifier: Apache-2.0
"""Between MuJoCo Warp's arrays in float32 and the rows of MuJoCo's full physics state that other kernels know."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def load_state_kernel(
    # inputs
    state: wp.array2d[wp.float64],  # [W, 1 + nq + nv + na] time, qpos, qvel, act
    # outputs
    time: wp.array[float],  # [W]
    qpos: wp.array2d[float],  # [W, nq]
    qvel: wp.array2d[float],  # [W, nv]
    act: wp.array2d[float],  # [W, na]
):
    """One thread: one number of one world's start."""
    w, i = wp.tid()
    nq = qpos.shape[1]
    nv = qvel.shape[1]
    value = float(state[w, i])
    if i == 0:
        time[w] = value
    elif i <= nq:
        qpos[w, i - 1] = value
    elif i <= nq + nv:
        qvel[w, i - 1 - nq] = value
    else:
        act[w, i - 1 - nq - nv] = value


@wp.kernel
def store_state_kernel(
    # inputs
    time: wp.array[float],  # [W]
    qpos: wp.array2d[float],  # [W, nq]
    qvel: wp.array2d[float],  # [W, nv]
    act: wp.array2d[float],  # [W, na]
    t: int,
    # outputs
    state: wp.array3d[wp.float64],  # [W, T, 1 + nq + nv + na]
):
    """One thread: one number of one world after control step t."""
    w, i = wp.tid()
    nq = qpos.shape[1]
    nv = qvel.shape[1]
    if i == 0:
        state[w, t, i] = wp.float64(time[w])
    elif i <= nq:
        state[w, t, i] = wp.float64(qpos[w, i - 1])
    elif i <= nq + nv:
        state[w, t, i] = wp.float64(qvel[w, i - 1 - nq])
    else:
        state[w, t, i] = wp.float64(act[w, i - 1 - nq - nv])


@wp.kernel
def store_row_kernel(
    # inputs
    values: wp.array2d[float],  # [W, n]
    t: int,
    # outputs
    rows: wp.array3d[wp.float64],  # [W, T, n]
):
    """One thread: one number of one world after control step t."""
    w, i = wp.tid()
    rows[w, t, i] = wp.float64(values[w, i])


@wp.kernel
def drive_kernel(
    # inputs
    control: wp.array3d[float],  # [T, W, nu]
    matrix: wp.array2d[float],  # [na, nu] actuator targets per control
    offset: wp.array[float],  # [na]
    t: int,
    # outputs
    ctrl: wp.array2d[float],  # [W, na]
):
    """One thread: the target of one actuator in one world during control step t."""
    w, a = wp.tid()
    target = offset[a]
    for i in range(matrix.shape[1]):
        target += matrix[a, i] * control[t, w, i]
    ctrl[w, a] = target


@wp.kernel
def place_mocap_kernel(
    # inputs
    mocap: wp.array2d[wp.transform],  # [W, nm]
    order: wp.array[int],  # [nm] MuJoCo's mocap body of each
    first: int,  # world of thread 0
    # outputs
    position: wp.array2d[wp.vec3],  # [W, nmocap]
    rotation: wp.array2d[wp.quat],  # [W, nmocap] (w, x, y, z)
):
    """One thread: where one mocap body of one world is."""
    thread, i = wp.tid()
    w = first + thread
    q = wp.transform_get_rotation(mocap[w, i])
    position[w, order[i]] = wp.transform_get_translation(mocap[w, i])
    rotation[w, order[i]] = wp.quat(q[3], q[0], q[1], q[2])
