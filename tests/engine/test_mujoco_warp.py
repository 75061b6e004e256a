# SPDX-License-Identifier: Apache-2.0
"""MJCF files in the engine ``mujoco_warp``, against plain MuJoCo on the same file, as far as float32 goes.

The first run with empty kernel caches compiles for about a minute per file.
"""

import mujoco
import numpy as np
import pytest
import warp as wp
from native_robots import (
    CARTPOLE,
    LEG_DRIVE,
    QUADROTOR,
    compiled_native,
    driven_model,
    installed,
    native_scene,
    plain_model,
    plain_rollout,
    random_controls,
    roll,
    start_of,
    without_contact,
)

from warpmpc import SceneError
from warpmpc.engine.mujoco_warp import MujocoWarpSimulator
from warpmpc.engine.newton import NewtonSimulator
from warpmpc.physics.version import VERSION
from warpmpc.scene.model.trajectory import BatchSize

STEPS = 50
BOUND = 1e-4 if VERSION >= (4, 0) else 1e-5
"""Relative. MuJoCo Warp alone beside MuJoCo, humanoid without contact, fifty steps of random controls: positions
differ by 2.8e-6 in 3.17 and 1.9e-5 in 4.0, velocities by 1.7e-4 and 1.9e-3.
"""


def asset_file(name: str, folder):
    match name:
        case "humanoid":
            return installed("newton", "examples/assets/nv_humanoid.xml")
        case "hand":
            return installed("gymnasium_robotics", "envs/assets/hand/reach.xml")
        case "mjlab cartpole":
            return installed("mjlab", "tasks/cartpole/cartpole.xml")
        case "quadruped":
            return installed("mjlab", "asset_zoo/robots/unitree_go1/xmls/go1.xml")
    # MuJoCo Warp has no implicit integrator, and takes activations otherwise in RK4
    text = {
        "cartpole": CARTPOLE.replace('integrator="implicit"', 'integrator="implicitfast"'),
        "quadrotor": QUADROTOR.replace("RK4", "Euler"),
        "quadrotor by RK4": QUADROTOR,
    }[name]
    (folder / f"{name}.xml").write_text(text)
    return folder / f"{name}.xml"


def warp_engine(scene, compiled, model, *, steps=STEPS, samples=1, **options) -> MujocoWarpSimulator:
    return MujocoWarpSimulator(
        scene,
        compiled,
        BatchSize(1, samples, 1, steps),
        substeps=[1] * steps,
        timestep=model.opt.timestep,
        device="cpu",
        **options,
    )


@pytest.mark.parametrize("name", ["cartpole", "quadrotor", "humanoid", "hand", "mjlab cartpole", "quadruped"])
def test_a_file_is_simulated_as_plain_mujoco_does_it(name, tmp_path):
    path = asset_file(name, tmp_path)
    keys = {"drive": LEG_DRIVE} if name == "quadruped" else {}
    compiled = compiled_native(path, **keys)
    model = driven_model(path, compiled.layout.control_name) if keys else plain_model(path)
    engine = warp_engine(native_scene(path, **keys), compiled, model)
    without_contact(model)
    engine.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    control = random_controls(compiled, STEPS)
    out = roll(engine, compiled, control)
    expected = plain_rollout(model, mujoco.MjData(model), control[:, 0])
    state = engine._state.numpy()[0, :, 1:]
    found = dict(zip(("qpos", "qvel", "act"), np.split(state, [model.nq, model.nq + model.nv], axis=1), strict=True))
    for key, values in found.items():
        scale = np.abs(expected[key]).max(initial=1.0)
        np.testing.assert_allclose(values, expected[key], atol=BOUND * scale, err_msg=key)
    np.testing.assert_allclose(out.body_q.numpy()[1:, 0, :, :3], expected["xpos"], atol=1e-5)
    np.testing.assert_allclose(out.act.numpy()[1:, 0], expected["act"], atol=1e-5)
    scale = np.abs(expected["sensordata"]).max(initial=1.0)
    np.testing.assert_allclose(out.sensor.numpy()[:, 0], expected["sensordata"], atol=max(3e-5, BOUND) * scale)
    assert not out.diverged.numpy().any()
    assert not out.overflow.numpy().any()


def test_activations_and_mocap_bodies_start_where_they_are_observed(tmp_path):
    path = asset_file("quadrotor", tmp_path)
    compiled, model = compiled_native(path, keyframe="hover"), plain_model(path)
    engine = warp_engine(native_scene(path), compiled, model, steps=3, samples=2)
    state = start_of(compiled)
    pose = np.array([0.3, 0.2, 0.9, 0.6, 0.0, 0.0, 0.8], dtype=np.float32)
    state.act.assign(np.array([[0.1, 0.9]], dtype=np.float32))
    state.mocap.assign(pose[None, None])
    engine.clone(state)
    engine.rollout(wp.array(np.repeat(random_controls(compiled, 3), 2, axis=1), dtype=float, device="cpu"))
    out, marker = engine.trajectory, compiled.layout.mocap_body[0]
    np.testing.assert_allclose(out.act.numpy()[0], [[0.1, 0.9]] * 2)
    np.testing.assert_allclose(out.body_q.numpy()[:, :, marker], np.tile(pose, (4, 2, 1)), atol=1e-6)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.act[:] = [0.1, 0.9]
    data.mocap_pos[0], data.mocap_quat[0] = pose[:3], pose[[6, 3, 4, 5]]
    expected = plain_rollout(model, data, random_controls(compiled, 3)[:, 0])
    for w in range(2):
        np.testing.assert_allclose(out.sensor.numpy()[:, w], expected["sensordata"], rtol=1e-4, atol=1e-4)


def test_what_mujoco_warp_does_otherwise_is_refused(tmp_path):
    path = asset_file("quadrotor by RK4", tmp_path)
    with pytest.raises(SceneError, match=r"RK4.*engine\.integrator"):
        warp_engine(native_scene(path), compiled_native(path), plain_model(path))


def test_newton_names_what_it_lacks(tmp_path):
    path = asset_file("cartpole", tmp_path)
    scene = native_scene(path)
    with pytest.raises(SceneError, match=r"actuators of the file.*tendons") as error:
        NewtonSimulator(
            scene, compiled_native(path), BatchSize(1, 1, 1, 2), substeps=[1, 1], timestep=0.005, pairs=(), device="cpu"
        )
    assert error.value.key == "engine.name"
