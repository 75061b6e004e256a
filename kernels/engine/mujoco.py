# SPDX-License-Identifier: Apache-2.0
"""MuJoCo's C engine called from a kernel: no Python between the physics steps of a roll-out."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class MujocoLibrary:
    """Addresses of functions of MuJoCo's C library."""

    step: wp.uint64  # mj_step
    set_state: wp.uint64  # mj_setState
    get_state: wp.uint64  # mj_getState


@wp.struct
class MujocoData:
    """One ``mjData`` per thread, and addresses of what lies in them."""

    data: wp.array[wp.uint64]  # [thread]
    warmstart: wp.array[wp.uint64]  # [thread] qacc_warmstart
    sensor: wp.array[wp.uint64]  # [thread] sensordata
    warning: wp.array[wp.uint64]  # [thread] number of the first warning
    warning_stride: int  # bytes from one warning's number to the next
    warnings: int  # kinds of warnings


_ROLL_OUT = """
    typedef void (*Step)(const void*, void*);
    typedef void (*SetState)(const void*, void*, const double*, unsigned int);
    typedef void (*GetState)(const void*, const void*, double*, unsigned int);
    const void* m = (const void*)model;
    void* d = (void*)data;
    double* states = (double*)state;
    double* sensors = (double*)sensordata;
    ((SetState)set_state)(m, d, (const double*)initial, full_spec);
    for (int i = 0; i < nv; ++i) ((double*)warmstart)[i] = 0.0;
    for (int i = 0; i < warnings; ++i) *(int*)((char*)warning + i * warning_stride) = 0;
    bool warned = false;
    for (int n = 0; n < steps; ++n) {
        if (!warned) {
            ((SetState)set_state)(m, d, (const double*)control + n * ncontrol, control_spec);
            ((Step)step)(m, d);
            for (int i = 0; i < warnings; ++i)
                warned = warned || *(const int*)((const char*)warning + i * warning_stride);
        }
        if (!warned) {
            ((GetState)get_state)(m, d, states + n * nstate, full_spec);
            for (int i = 0; i < nsensor; ++i) sensors[n * nsensor + i] = ((const double*)measured)[i];
            continue;
        }
        // the world blew up, be it in its last step: the last good state stays, as its time shows
        const double* before = n > 0 ? states + (n - 1) * nstate : (const double*)initial;
        for (int i = 0; i < nstate; ++i) states[n * nstate + i] = before[i];
        for (int i = 0; i < nsensor; ++i) sensors[n * nsensor + i] = n > 0 ? sensors[(n - 1) * nsensor + i] : 0.0;
    }
"""


@wp.func_native(_ROLL_OUT)
def roll_out_mujoco(
    model: wp.uint64,
    data: wp.uint64,
    step: wp.uint64,
    set_state: wp.uint64,
    get_state: wp.uint64,
    warmstart: wp.uint64,
    measured: wp.uint64,
    warning: wp.uint64,
    warning_stride: int,
    warnings: int,
    initial: wp.uint64,
    control: wp.uint64,
    state: wp.uint64,
    sensordata: wp.uint64,
    full_spec: int,
    control_spec: int,
    nv: int,
    nstate: int,
    ncontrol: int,
    nsensor: int,
    steps: int,
):
    """Step one world as ``mujoco.rollout`` does, from a state, without warm start, until MuJoCo warns of a step."""
    ...


@wp.kernel
def mujoco_rollout_kernel(
    # inputs
    library: MujocoLibrary,
    data: MujocoData,
    model: wp.array[wp.uint64],  # [W] address of each world's mjModel
    thread: wp.array[int],  # [part] thread that takes each part of the worlds
    part: int,
    first: int,  # world of thread 0
    nv: int,
    full_spec: int,
    control_spec: int,
    initial: wp.array2d[wp.float64],  # [W, nstate]
    control: wp.array3d[wp.float64],  # [W, N, ncontrol]
    # outputs
    state: wp.array3d[wp.float64],  # [W, N, nstate]
    sensordata: wp.array3d[wp.float64],  # [W, N, nsensor]
):
    """One thread: all physics steps of one world, in MuJoCo's C engine; for the CPU alone."""
    w = first + wp.tid()
    t = thread[part]
    steps = state.shape[1]
    eight = wp.uint64(8)
    row = wp.uint64(w)
    nstate = wp.uint64(state.shape[2])
    width = wp.uint64(steps) * eight
    roll_out_mujoco(
        model[w],
        data.data[t],
        library.step,
        library.set_state,
        library.get_state,
        data.warmstart[t],
        data.sensor[t],
        data.warning[t],
        data.warning_stride,
        data.warnings,
        initial.ptr + row * nstate * eight,
        control.ptr + row * width * wp.uint64(control.shape[2]),
        state.ptr + row * width * nstate,
        sensordata.ptr + row * width * wp.uint64(sensordata.shape[2]),
        full_spec,
        control_spec,
        nv,
        state.shape[2],
        control.shape[2],
        sensordata.shape[2],
        steps,
    )
