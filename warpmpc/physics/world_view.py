# SPDX-License-Identifier: Apache-2.0
"""View of a reward, a termination or an observation: one world of a simulator, and the functions that read it.

They are named as those that cost terms read a :class:`~warpmpc.StepView` with. An index out of range reads no number,
and the environment raises an error.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class WorldView:
    """One world after a step: everything that a reward, a termination or an observation may look at."""

    w: int  # world
    state: wp.array2d[wp.float64]  # [W, 1+nq+nv+na] time, coordinates, velocities, activations
    nq: int  # number of coordinates
    nv: int  # number of velocities
    poses: wp.array3d[float]  # [W, nbody, 7] positions [m] and quaternions (w, x, y, z)
    readings: wp.array2d[wp.float64]  # [W, nsensordata]
    forces: wp.array3d[float]  # [W, pairs, 3] [N]
    controls: wp.array2d[float]  # [W, nu] that led here
    controls_before: wp.array2d[float]  # [W, nu] of the step before
    outside: wp.array[int]  # [1] 1 + index in KINDS of what an index was out of range for; 0 if none was


KINDS = "coordinate", "velocity", "body", "sensor reading", "pair", "control"
"""What functions read by an index."""


@wp.func
def _there(s: WorldView, kind: int, i: int, count: int) -> bool:
    """Return whether an index is in range; if not, it is noted."""
    if i < 0 or i >= count:
        s.outside[0] = 1 + kind
        return False
    return True


@wp.func
def _nothing() -> wp.vec3:
    """No numbers."""
    return wp.vec3(wp.nan, wp.nan, wp.nan)


@wp.func
def step_time(s: WorldView) -> float:
    """Time since the episode began [s]."""
    return float(s.state[s.w, 0])


@wp.func
def joint_position(s: WorldView, i: int) -> float:
    """Coordinate i of MuJoCo's ``qpos`` [m or rad]."""
    if not _there(s, 0, i, s.nq):
        return wp.nan
    return float(s.state[s.w, 1 + i])


@wp.func
def joint_velocity(s: WorldView, i: int) -> float:
    """Velocity i of MuJoCo's ``qvel`` [m/s or rad/s]."""
    if not _there(s, 1, i, s.nv):
        return wp.nan
    return float(s.state[s.w, 1 + s.nq + i])


@wp.func
def body_position(s: WorldView, body: int) -> wp.vec3:
    """Position of a body in the world [m]."""
    if not _there(s, 2, body, s.poses.shape[1]):
        return _nothing()
    return wp.vec3(s.poses[s.w, body, 0], s.poses[s.w, body, 1], s.poses[s.w, body, 2])


@wp.func
def body_rotation(s: WorldView, body: int) -> wp.quat:
    """Orientation of a body in the world."""
    if not _there(s, 2, body, s.poses.shape[1]):
        return wp.quat(wp.nan, wp.nan, wp.nan, wp.nan)
    return wp.quat(s.poses[s.w, body, 4], s.poses[s.w, body, 5], s.poses[s.w, body, 6], s.poses[s.w, body, 3])


@wp.func
def sensor(s: WorldView, i: int) -> float:
    """Number i of MuJoCo's ``sensordata``, in the sensor's own unit."""
    if not _there(s, 3, i, s.readings.shape[1]):
        return wp.nan
    return float(s.readings[s.w, i])


@wp.func
def contact_force(s: WorldView, pair: int) -> wp.vec3:
    """Mean contact force on the first body of a watched pair during the step [N]."""
    if not _there(s, 4, pair, s.forces.shape[1]):
        return _nothing()
    return wp.vec3(s.forces[s.w, pair, 0], s.forces[s.w, pair, 1], s.forces[s.w, pair, 2])


@wp.func
def control(s: WorldView, i: int) -> float:
    """Control i that led here; at the start of an episode that of an action at rest."""
    if not _there(s, 5, i, s.controls.shape[1]):
        return wp.nan
    return s.controls[s.w, i]


@wp.func
def control_before(s: WorldView, i: int) -> float:
    """The same control one step before."""
    if not _there(s, 5, i, s.controls_before.shape[1]):
        return wp.nan
    return s.controls_before[s.w, i]
