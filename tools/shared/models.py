# SPDX-License-Identifier: Apache-2.0
"""MuJoCo models whose physics is timed: a quadruped, a humanoid, an arm with a box, a hand, and those of scenes."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco
import numpy as np

import warpmpc
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.mujoco_model import Options, make_world

FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
OPTION = '<option timestep="0.005" integrator="Euler" iterations="20" tolerance="1e-6"/>'
_LEG = """
<body name="{n}_hip" pos="{x} {y} 0"><joint name="{n}_hip" axis="1 0 0" range="-0.8 0.8"/>
  <inertial pos="0 {s} 0" mass="0.7" diaginertia="0.0007 0.0007 0.0005"/>
  <body name="{n}_thigh" pos="0 {s2} 0"><joint name="{n}_thigh" axis="0 1 0" range="-1 3"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="1"/>
    <body name="{n}_calf" pos="0 0 -0.2"><joint name="{n}_calf" axis="0 1 0" range="-2.7 -0.8"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.19" size="0.013" mass="0.15"/>
      <geom type="sphere" size="0.02" pos="0 0 -0.2" mass="0.06" friction="0.8"/>
    </body></body></body>"""


def quadruped_spec() -> mujoco.MjSpec:
    """Twelve joints like those of a Go1, trunk and legs of simple shapes, servos with limits."""
    legs = "".join(
        _LEG.format(n=name, x=x, y=y, s=0.04 * np.sign(y), s2=0.08 * np.sign(y))
        for name, x, y in (("fr", 0.19, -0.05), ("fl", 0.19, 0.05), ("rr", -0.19, -0.05), ("rl", -0.19, 0.05))
    )
    joints = [f"{leg}_{part}" for leg in ("fr", "fl", "rr", "rl") for part in ("hip", "thigh", "calf")]
    servos = "".join(f'<position joint="{j}" kp="30" kv="1" forcerange="-24 24"/>' for j in joints)
    pose = " ".join(["0 0.9 -1.8"] * 4)
    return mujoco.MjSpec.from_string(f"""
<mujoco><compiler angle="radian" autolimits="true"/>{OPTION}
<default><joint armature="0.01" damping="0.3"/><geom condim="3"/></default>
<worldbody><geom type="plane" size="9 9 .1"/>
<body name="trunk" pos="0 0 0.3"><freejoint/><geom type="box" size=".19 .05 .06" mass="5"/>{legs}</body></worldbody>
<actuator>{servos}</actuator>
<keyframe><key qpos="0 0 0.3 1 0 0 0 {pose}" ctrl="{pose}"/></keyframe></mujoco>""")


def quadruped() -> mujoco.MjModel:
    """The model of :func:`quadruped_spec`."""
    return quadruped_spec().compile()


def arm_with_box() -> mujoco.MjModel:
    """Seven hinges on a column with a ball at the hand, and a box on the floor before it."""
    links, end, bits = "", "", "contype='0' conaffinity"
    for i, length in enumerate((0.05, 0.2, 0.2, 0.2, 0.15, 0.1, 0.05)):
        axis = "0 1 0" if i % 2 else "0 0 1"
        links += (
            f'<body pos="0 0 {0.33 if i == 0 else 0.0}">'
            f'<joint name="j{i}" axis="{axis}" range="-2.6 2.6" damping="1" armature="0.1"/>'
            f'<geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.05" mass="1.5" {bits}="{int(i > 3)}"/>'
            f'<body pos="0 0 {length}">'
        )
        end += "</body></body>"
    servos = "".join(f'<position joint="j{i}" kp="400" kv="40" forcerange="-80 80"/>' for i in range(7))
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><compiler angle="radian" autolimits="true"/>{OPTION}
<worldbody><geom type="plane" size="9 9 .1"/>
{links}<geom type="sphere" size="0.06" mass="0.4" contype="0" conaffinity="1"/>{end}
<body name="box" pos="0.55 0 0.1"><freejoint/><geom type="box" size=".08 .12 .1" mass="0.8"/></body></worldbody>
<actuator>{servos}</actuator>
<keyframe><key qpos="0 1.1 0 0.9 0 0.3 0 0.55 0 0.1 1 0 0 0" ctrl="0 1.1 0 0.9 0 0.3 0"/></keyframe></mujoco>""")


def _file(package: str, name: str) -> Path:
    """A file of an installed package."""
    return Path(importlib.util.find_spec(package).submodule_search_locations[0]) / name


def humanoid_spec() -> mujoco.MjSpec:
    """Newton's ``nv_humanoid.xml`` with its own motors over a floor."""
    spec = mujoco.MjSpec.from_file(str(_file("newton", "examples/assets/nv_humanoid.xml")))
    for item in (*spec.sensors, *spec.tendons):
        spec.delete(item)
    if not any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.geoms):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9.0, 9.0, 0.1])
    return spec


def humanoid() -> mujoco.MjModel:
    """The model of :func:`humanoid_spec`, without the springs of its free joint."""
    model = humanoid_spec().compile()
    model.jnt_stiffness[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE] = 0.0
    model.opt.timestep, model.opt.integrator = 0.005, mujoco.mjtIntegrator.mjINT_EULER
    model.opt.iterations, model.opt.tolerance = 20, 1e-6
    model.qpos0[2] = 1.3
    return model


def g1_spec() -> mujoco.MjSpec:
    """The G1 of mjlab over a floor, a servo with a limit on each joint."""
    path = _file("mjlab", "asset_zoo/robots/unitree_g1/xmls/g1.xml")
    spec = mujoco.MjSpec.from_file(str(path))
    spec.meshdir = str(path.parent / "assets")
    spec.option.timestep, spec.option.iterations, spec.option.tolerance = 0.005, 20, 1e-6
    for sensor in spec.sensors:
        spec.delete(sensor)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9.0, 9.0, 0.1])
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.armature = 0.01
            servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=75.0, kv=2.0)
            servo.forcelimited, servo.forcerange = True, [-88.0, 88.0]
    return spec


def g1() -> mujoco.MjModel:
    """The model of :func:`g1_spec`."""
    return g1_spec().compile()


def warp_humanoid_spec() -> mujoco.MjSpec:
    """The humanoid of MuJoCo Warp's own benchmark, as its file has it."""
    return mujoco.MjSpec.from_file(str(_file("mujoco_warp", "test_data/humanoid/humanoid.xml")))


def warp_humanoid() -> mujoco.MjModel:
    """The model of :func:`warp_humanoid_spec`."""
    return warp_humanoid_spec().compile()


def hand_spec() -> mujoco.MjSpec:
    """The Shadow hand of gymnasium-robotics, as its file has it."""
    return mujoco.MjSpec.from_file(str(_file("gymnasium_robotics", "envs/assets/hand/reach.xml")))


def hand() -> mujoco.MjModel:
    """The model of :func:`hand_spec`."""
    return hand_spec().compile()


def hand_with_block() -> mujoco.MjModel:
    """The same with a block in it, and one contact of two flat shapes."""
    path = _file("gymnasium_robotics", "envs/assets/hand/manipulate_block.xml")
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
    return model


def load_model(name: str) -> mujoco.MjModel:
    """A model of :data:`OWN` or :data:`OTHERS`, or a scene's, by name."""
    made = OWN | OTHERS
    return made[name]() if name in made else of_scene(name)


def of_scene(name: str) -> mujoco.MjModel:
    """The model of a shipped scene, as its rollouts step it."""
    return model_of(warpmpc.load_scene(name))


def model_of(scene: warpmpc.Scene) -> mujoco.MjModel:
    """The model of a scene, as its rollouts step it."""
    compiled = compile_scene(scene)
    substeps = compiled.substeps(scene.engine.substeps, scene.timing.control_dt, 2)
    step = scene.timing.control_dt / substeps
    return make_world(compiled, timestep=step, options=Options.of(scene.engine), sensors=()).model


OWN = {"quadruped": quadruped, "humanoid": humanoid, "arm_with_box": arm_with_box}
OTHERS = {"hand": hand, "hand_with_block": hand_with_block, "g1": g1, "warp_humanoid": warp_humanoid}
"""Models of files that are installed beside this project."""
SCENES = (
    "omni_push_box",
    "omni_push_sphere",
    "diff_push_box",
    "panda_push_objects",
    "panda_reach",
    "point_reach",
    "mobile_pick",
    "push_t",
    "humanoid_stand",
)


def spread(model: mujoco.MjModel, worlds: int, *, seconds: float = 0.4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates, velocities and controls that worlds have come to after a while of random controls."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    q, v = np.empty((worlds, model.nq)), np.empty((worlds, model.nv))
    rest, start = data.ctrl.copy(), (data.qpos.copy(), data.qvel.copy())
    limited = model.actuator_ctrllimited.astype(bool)
    width = np.where(limited, 0.5 * np.ptp(model.actuator_ctrlrange, axis=1), 0.5)
    u = rest + 0.5 * width * rng.normal(size=(worlds, model.nu))
    steps = int(seconds / model.opt.timestep)
    for w in range(worlds):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = *start, u[w]
        mujoco.mj_step(model, data, steps)
        q[w], v[w] = data.qpos, data.qvel
    return q, v, u.astype(np.float32).astype(float)
