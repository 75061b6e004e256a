# SPDX-License-Identifier: Apache-2.0
"""What the engine `fused` records of ball and free joints and of activations is what the engine `mujoco` records."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from native_robots import QUADROTOR, native_scene
from small_scenes import chain_scene

from warpmpc.engine.fused_physics import FusedPhysics
from warpmpc.engine.mujoco import MujocoSimulator
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.mujoco_model import Options
from warpmpc.scene.model.trajectory import BatchSize

SHAPE = BatchSize(2, 4, 1, 3)


def quadrotor(folder):
    path = folder / "quadrotor.xml"
    text = QUADROTOR.replace('integrator="RK4"', 'integrator="implicitfast"')  # in air
    path.write_text(text)
    return native_scene(path)


@pytest.mark.parametrize("make", [chain_scene, quadrotor])
def test_both_engines_record_the_same(make, tmp_path):
    scene = make(tmp_path)
    compiled = compile_scene(scene)
    layout, rng = compiled.layout, np.random.default_rng(0)

    def rows(values, dtype=float) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.float32), dtype=dtype)

    state = SimpleNamespace(
        joint_q=rows(np.tile(layout.joint_q, (2, 1))),
        joint_qd=rows(0.3 * rng.normal(size=(2, layout.nv))),
        act=rows(rng.uniform(0.2, 0.8, size=(2, layout.na)).reshape(2, -1)),
        mocap=rows(np.tile(layout.mocap, (2, 1, 1)).reshape(2, -1, 7), wp.transform),
        pose=rows(np.zeros((2, 0, 7)), wp.transform),
    )
    common = {"substeps": [2] * SHAPE.horizon, "timestep": 0.004}
    fused = FusedPhysics(scene, compiled, SHAPE, device="cpu", **common)
    reference = MujocoSimulator(compiled, SHAPE, threads=1, options=Options.of(scene.engine), sensors=(), **common)
    control = rows(rng.uniform(0.2, 1.0, size=(SHAPE.horizon, SHAPE.worlds, layout.nu)))
    for engine in (fused, reference):
        engine.clone(state)
        engine.rollout(control)
    ours, theirs = fused.trajectory, reference.trajectory
    for name in ("joint_q", "joint_qd", "body_q", "body_qd", "act"):
        a, b = (getattr(out, name).numpy() for out in (ours, theirs))
        if name == "body_q":  # a quaternion and its negative are one rotation
            a[..., 3:] *= np.where((a[..., 3:] * b[..., 3:]).sum(axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
        np.testing.assert_allclose(a, b, atol=3e-4, err_msg=name)
    assert layout.na == 0 or np.ptp(ours.act.numpy()[:, 0, 0]) > 0.01
