# SPDX-License-Identifier: Apache-2.0
"""Tasks of ``ppo.py``: a cart-pole that stands, robots of mjlab that walk (``pip install --no-deps mjlab``)."""

import re
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import warp as wp

from warpmpc.kernels.cost.view import yaw
from warpmpc.physics import BatchSimulator
from warpmpc.physics.vector_env import BatchVectorEnv
from warpmpc.physics.world_view import (
    WorldView,
    body_position,
    body_rotation,
    contact_force,
    control,
    control_before,
    joint_position,
    joint_velocity,
    step_time,
)

GO1 = {"calf": (0.00906, 35.55, -1.8), "thigh": (0.00403, 23.7, 0.9), "hip": (0.00403, 23.7, 0.0)}
"""Of joints that a pattern matches: inertia of the rotor [kg·m²], limit [N·m], angle at home [rad]; the first holds."""
G1 = {
    "hip_pitch": (0.01018, 88.0, -0.312),
    "hip_roll": (0.0251, 139.0, 0.0),
    "knee": (0.0251, 139.0, 0.669),
    "hip_yaw|waist_yaw": (0.01018, 88.0, 0.0),
    "ankle_pitch": (0.00722, 50.0, -0.363),
    "ankle|waist": (0.00722, 50.0, 0.0),
    "elbow": (0.00361, 25.0, 0.6),
    "shoulder|wrist_roll": (0.00361, 25.0, 0.0),
    "wrist": (0.00425, 5.0, 0.0),
}
"""The same of the humanoid."""
ROBOTS = {
    "go1": (GO1, 0.29, {"FR_calf": 0.0, "RL_calf": 0.0, "FL_calf": 0.5, "RR_calf": 0.5}, 0.5, 0.8, 0.5),
    "g1": (G1, 0.77, {"left_ankle_roll_link": 0.0, "right_ankle_roll_link": 0.5}, 0.8, 0.7, 0.25),
}
"""Joints, height at home [m], feet and phases of their steps, period of the gait [s], wanted speed [m/s], and how far
targets go from home, as a share of what the motor can hold."""


def cartpole(_: str, worlds: int, threads: int) -> BatchVectorEnv:
    """A cart-pole that begins upright: one for every step in which it stands, 500 at most."""
    model = mujoco.MjModel.from_xml_path(str(Path(__file__).parents[1] / "scenes" / "assets" / "cartpole.xml"))

    @wp.func
    def observe(s: WorldView, o: wp.array[float]):
        for i in range(2):
            o[i] = joint_position(s, i)
            o[2 + i] = joint_velocity(s, i)

    @wp.func
    def fallen(s: WorldView) -> bool:
        return wp.abs(joint_position(s, 1)) > 0.2 or wp.abs(joint_position(s, 0)) > 1.7

    @wp.func
    def standing(s: WorldView) -> float:
        return 1.0

    return BatchVectorEnv(
        BatchSimulator(model, worlds, threads=threads), observe=observe, size=4, rewards={standing: 1.0},
        terminations=[fallen], start=lambda rng, w: {k: rng.uniform(-0.1, 0.1, (len(w), 2)) for k in ("qpos", "qvel")},
        actions=(0.0, 10.0), substeps=2, max_episode_steps=500, autoreset_mode="SameStep",
    )  # fmt: skip


def walking(name: str, worlds: int, threads: int) -> BatchVectorEnv:
    """A robot of mjlab's that walks along x at 50 Hz by targets of its joints, its feet in the rhythm of a gait."""
    table, height, feet, period, speed, reach = ROBOTS[name]
    if find_spec("mjlab") is None:
        raise SystemExit(f"error: {name} needs mjlab: pip install --no-deps mjlab")
    folder = Path(find_spec("mjlab").submodule_search_locations[0]) / "asset_zoo" / "robots" / f"unitree_{name}"
    spec = mujoco.MjSpec.from_file(str(folder / "xmls" / f"{name}.xml"))
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for geom in spec.geoms:  # feet alone touch the floor
        geom.contype, geom.conaffinity = 0, int(bool(re.search("_foot[26]?_collision", geom.name)))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=0)
    spec.option.timestep, spec.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    home, scale = [], []
    for joint in spec.joints[1:]:
        inertia, limit, angle = next(row for pattern, row in table.items() if re.search(pattern, joint.name))
        joint.armature = inertia  # gains are those of 10 Hz and twice the critical damping
        motor = spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcerange=[-limit, limit])
        motor.set_to_position(kp=inertia * 62.8**2, kv=4.0 * inertia * 62.8)
        home.append(angle)
        scale.append(reach * limit / (inertia * 62.8**2))
    model = spec.compile()
    n, count = len(home), len(feet)
    rest, phases = wp.types.vector(n, float)(home), wp.types.vector(count, float)(list(feet.values()))
    stand = np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0, *home])

    @wp.func
    def observe(s: WorldView, o: wp.array[float]):
        q = wp.quat_inverse(body_rotation(s, 1))
        up = wp.quat_rotate(q, wp.vec3(0.0, 0.0, 1.0))
        ahead = wp.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
        for k in range(3):
            o[k] = up[k]
            o[3 + k] = ahead[k]
        for k in range(6):
            o[6 + k] = joint_velocity(s, k)
        o[12] = wp.sin(6.2832 * step_time(s) / period)
        o[13] = wp.cos(6.2832 * step_time(s) / period)
        for i in range(n):
            o[14 + i] = joint_position(s, 7 + i)
            o[14 + n + i] = joint_velocity(s, 6 + i)
            o[14 + 2 * n + i] = control(s, i)

    @wp.func
    def on_course(s: WorldView) -> float:
        v, w = wp.vec2(joint_velocity(s, 0) - speed, joint_velocity(s, 1)), joint_velocity(s, 5)
        return wp.exp(-4.0 * wp.length_sq(v)) + 0.5 * wp.exp(-4.0 * yaw(body_rotation(s, 1)) ** 2.0 - 0.5 * w * w)

    @wp.func
    def gait(s: WorldView) -> float:
        agree = wp.float32(0.0)
        for foot in range(count):
            down = wp.sin(6.2832 * (step_time(s) / period + phases[foot])) > 0.0
            agree += wp.where((contact_force(s, foot)[2] > 1.0) == down, 1.0, 0.0)
        return agree / float(count)

    @wp.func
    def unsteady(s: WorldView) -> float:
        tilt = 1.0 - wp.quat_rotate(body_rotation(s, 1), wp.vec3(0.0, 0.0, 1.0))[2]
        turn = wp.vec3(joint_velocity(s, 2), 0.2 * joint_velocity(s, 3), 0.2 * joint_velocity(s, 4))
        return 5.0 * tilt + wp.length_sq(turn)

    @wp.func
    def effort(s: WorldView) -> float:
        total = wp.float32(0.0)
        for i in range(n):
            total += (joint_position(s, 7 + i) - rest[i]) ** 2.0 + (control(s, i) - control_before(s, i)) ** 2.0
        return total

    @wp.func
    def fallen(s: WorldView) -> bool:
        up = wp.quat_rotate(body_rotation(s, 1), wp.vec3(0.0, 0.0, 1.0))
        return up[2] < 0.7 or body_position(s, 1)[2] < 0.6 * height

    def start(rng: np.random.Generator, w: np.ndarray) -> dict[str, np.ndarray]:
        noise = rng.uniform(-0.1, 0.1, (len(w), model.nq)) * ([0.0] * 7 + [1.0] * n)
        return {"qpos": stand + noise, "qvel": rng.uniform(-0.2, 0.2, (len(w), model.nv))}

    return BatchVectorEnv(
        BatchSimulator(model, worlds, threads=threads, contact_pairs=[(foot, "world") for foot in feet]),
        observe=observe, size=14 + 3 * n, rewards={on_course: 1.0, gait: 1.0, unsteady: -0.5, effort: -0.1},
        terminations=[fallen], start=start, actions=(home, scale), substeps=4, max_episode_steps=500,
        autoreset_mode="SameStep",
    )  # fmt: skip
