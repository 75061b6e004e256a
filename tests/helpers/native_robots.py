# SPDX-License-Identifier: Apache-2.0
"""MJCF files as their authors wrote them, in a separate scene and alone in plain MuJoCo."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pytest
import warp as wp
from needs import reason

from warpmpc import Scene
from warpmpc.engine.mujoco import MujocoSimulator
from warpmpc.scene.model.compiled import CompiledScene, compile_scene
from warpmpc.scene.model.trajectory import BatchSize

if TYPE_CHECKING:
    from warpmpc.scene.model.trajectory import Trajectory

QUADROTOR = """
<mujoco model="quadrotor">
  <option timestep="0.004" integrator="RK4" density="1.225" viscosity="1.8e-5"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="frame" pos="0 0 0.5"><freejoint name="root"/>
      <inertial pos="0.01 0 -0.005" mass="0.325" diaginertia="0.0008 0.0009 0.0016"/>
      <geom name="plate" type="box" size="0.06 0.06 0.01"/>
      <site name="imu" pos="0 0 0.02" quat="0.9 0.1 -0.2 0.3"/>
      <site name="thrust1" pos="0.14 0.18 0.01"/> <site name="thrust2" pos="-0.14 0.18 0.01"/>
      <site name="thrust3" pos="-0.14 -0.18 0.01"/> <site name="thrust4" pos="0.14 -0.18 0.01"/>
    </body>
    <body name="marker" mocap="true" pos="1 0 1" quat="0.6 0 0 0.8">
      <geom type="sphere" size="0.05" contype="0" conaffinity="0"/><site name="beacon" pos="0 0 0.1"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="t1" site="thrust1" gear="0 0 1 0 0 -0.02" ctrlrange="0 3"/>
    <motor name="t2" site="thrust2" gear="0 0 1 0 0 0.02" ctrlrange="0 3"/>
    <general name="t3" site="thrust3" gear="0 0 1 0 0 -0.02" ctrlrange="0 3" dyntype="filter" dynprm="0.05"/>
    <general name="t4" site="thrust4" gear="0 0 1 0 0 0.02" ctrlrange="0 3" dyntype="filterexact" dynprm="0.03"/>
  </actuator>
  <sensor>
    <gyro name="gyro" site="imu"/> <accelerometer name="accelerometer" site="imu"/>
    <framequat name="attitude" objtype="site" objname="imu"/>
    <framepos name="way" objtype="site" objname="beacon" reftype="site" refname="imu"/>
  </sensor>
  <keyframe>
    <key name="hover" qpos="0.1 0.2 1.3 0.99 0.1 0 0.1" qvel="0.1 0 0 0.2 0.3 0.4" ctrl="0.8 0.8 0.7 0.7" act="0.6 0.5"
         mpos="1 1 1" mquat="0 1 0 0"/>
  </keyframe>
</mujoco>
"""
"""Four thrusters at sites, two of them with dynamics; a mocap body; an inertial sensor; a keyframe."""

CARTPOLE = """
<mujoco model="cartpole">
  <compiler autolimits="true" angle="radian"/>
  <option timestep="0.005" integrator="implicit"/>
  <default><default class="pole"><geom type="capsule" fromto="0 0 0 0 0 1" size="0.045"/></default></default>
  <worldbody>
    <geom name="rail" type="capsule" pos="0 .3 1" zaxis="1 0 0" size="0.02 2"/>
    <site name="origin" pos="0 0 1"/>
    <body name="cart" pos="0 0 1">
      <joint name="slider" type="slide" axis="1 0 0" range="-1.8 1.8" ref="0.2" damping="0.05"/>
      <geom type="box" size="0.2 0.15 0.1" mass="1"/>
      <body name="pole" childclass="pole">
        <joint name="hinge" axis="0 1 0" ref="0.3" damping="2e-3"/><geom mass="0.1"/><site name="tip" pos="0 0 1"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="both"><joint joint="slider" coef="1"/><joint joint="hinge" coef="0.1"/></fixed></tendon>
  <actuator>
    <motor joint="slider" gear="10" ctrlrange="-1 1"/>
    <position name="hold" joint="hinge" kp="3" kv="0.1" ctrlrange="-1 1" forcerange="-0.5 0.5"/>
    <muscle name="pull" tendon="both" lengthrange="-2 2" ctrlrange="0 1"/>
  </actuator>
  <sensor><jointpos joint="hinge"/><framepos name="tip" objtype="site" objname="tip"/></sensor>
  <keyframe><key name="down" qpos="0.4 2.8" qvel="0.1 -0.2" act="0.3" ctrl="0.5 0.7 0.2"/></keyframe>
</mujoco>
"""
"""Joints that stand at ref in the file's pose, a motor without a name, a servo, a muscle on a tendon, a keyframe."""


def installed(package: str, path: str) -> Path:
    """A file of a package that is installed for its assets alone; skips the test where it is not."""
    spec = importlib.util.find_spec(package)
    file = Path(spec.submodule_search_locations[0]) / path if spec else None
    if file is None or not file.is_file():
        pytest.skip(reason(package))
    return file


def native_scene(asset: Path, *, ground: dict | None = None, **robot) -> Scene:
    """A scene of one MJCF file, called ``r``."""
    return Scene.model_validate(
        {
            "robot": [{"name": "r", "asset": str(asset), **robot}],
            "ground": ground,
            "goal": {"frame": "r", "position": (0.0, 0.0)},
            "cost": [{"term": "distance", "between": ["r", "goal"]}],
            "success": {"distance": 0.1},
        }
    )


def plain_model(asset: Path) -> mujoco.MjModel:
    """What MuJoCo makes of the file alone; sensors of sites that it lacks, which MuJoCo refuses, are left out."""
    spec = mujoco.MjSpec.from_file(str(asset))
    sites = {site.name for site in spec.sites}
    for sensor in list(spec.sensors):
        if sensor.objtype == mujoco.mjtObj.mjOBJ_SITE and sensor.objname not in sites:
            spec.delete(sensor)
    return spec.compile()


LEG_DRIVE = {"mode": "position", "stiffness": 40.0, "damping": 1.0, "lower": -2.0, "upper": 2.0}
"""A drive for a quadruped whose file has no actuators."""


def driven_model(asset: Path, joints: tuple[str, ...]) -> mujoco.MjModel:
    """What MuJoCo makes of a file with the servos of :data:`LEG_DRIVE` on joints, ``r/joint``."""
    spec = mujoco.MjSpec.from_file(str(asset))
    for name in joints:
        actuator = spec.add_actuator(name=name, target=name[2:], trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=40.0, kv=1.0)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec.compile()


def start_of(compiled: CompiledScene) -> SimpleNamespace:
    """What an engine is cloned from, on the CPU: the scene's start as one environment."""
    layout = compiled.layout
    return SimpleNamespace(
        joint_q=wp.array(layout.joint_q[None], dtype=float, device="cpu"),
        joint_qd=wp.array(layout.joint_qd[None], dtype=float, device="cpu"),
        act=wp.array(layout.act[None], dtype=float, device="cpu"),
        mocap=wp.array(layout.mocap[None], dtype=wp.transform, device="cpu"),
    )


def random_controls(compiled: CompiledScene, steps: int, seed: int = 0) -> np.ndarray:
    """Controls within their limits ``[T, 1, nu]``."""
    layout = compiled.layout
    size = (steps, 1, layout.nu)
    return np.random.default_rng(seed).uniform(layout.control_lower, layout.control_upper, size).astype(np.float32)


def without_contact(model: mujoco.MjModel) -> None:
    """Switch contacts off."""
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)


def plain_rollout(model: mujoco.MjModel, data: mujoco.MjData, control: np.ndarray) -> dict[str, np.ndarray]:
    """States of plain MuJoCo after every step ``[T, n]``, and its sensors, under controls ``[T, model.nu]``."""
    rows: dict[str, list] = {"qpos": [], "qvel": [], "act": [], "sensordata": [], "xpos": [], "site_xpos": []}
    for ctrl in control:
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data)
        for name in ("qpos", "qvel", "act", "sensordata"):
            rows[name].append(getattr(data, name).copy())
        mujoco.mj_kinematics(model, data)
        rows["xpos"].append(data.xpos[1:].copy())
        rows["site_xpos"].append(data.site_xpos.copy())
    return {name: np.array(values) for name, values in rows.items()}


def mujoco_engine(compiled: CompiledScene, steps: int, timestep: float, **options) -> MujocoSimulator:
    """The engine ``mujoco`` with one world and one physics step per control."""
    return MujocoSimulator(compiled, BatchSize(1, 1, 1, steps), substeps=[1] * steps, timestep=timestep, **options)


def roll(engine, compiled: CompiledScene, control: np.ndarray) -> Trajectory:
    """Roll controls ``[T, 1, nu]`` out from the scene's start."""
    engine.clone(start_of(compiled))
    engine.rollout(wp.array(control, dtype=float, device=engine.device))
    return engine.trajectory


def compiled_native(asset: Path, **keys) -> CompiledScene:
    """A scene of one MJCF file, compiled."""
    return compile_scene(native_scene(asset, **keys), cache=False)
