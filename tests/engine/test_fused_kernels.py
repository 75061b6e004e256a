# SPDX-License-Identifier: Apache-2.0
"""What the source of `fused` does in its launch is what the Warp kernels of the other engines do, world by world."""

import numpy as np
import pytest
import warp as wp
from small_scenes import BOX, DISC, WALL, compiled, make_engine, make_scene, observed, random_state

from warpmpc.engine.fused_physics import FusedPhysics
from warpmpc.engine.mujoco_warp import MujocoWarpSimulator
from warpmpc.kernels.engine.clone import clone_state_kernel
from warpmpc.scene.model.joints import joint_table
from warpmpc.scene.model.mujoco_model import Options
from warpmpc.scene.model.pairs import Pair
from warpmpc.scene.model.properties import draw_properties
from warpmpc.scene.model.trajectory import BatchSize

ENVS, SAMPLES, HORIZON = 2, 8, 4
SHAPE = BatchSize(ENVS, SAMPLES, 1, HORIZON)
PAIRS = (Pair("base", "box"), Pair("box", "ground"), Pair("box", "wall"), Pair("base", "wall"))
RANDOM = {
    "box": {"mass": {"uniform": 0.3}, "friction": {"uniform": 0.3}, "size": {"normal": 0.005}},
    "base": {"mass": {"uniform": 0.2}, "friction": {"uniform": 0.2}},
}
PUSHER = {**DISC, "asset": "omni_base.urdf", "position": (0.0, 0.0, 0.0)}
WORLDS = pytest.mark.parametrize("rules", [{}, RANDOM], ids=["nominal", "randomized"])


def pushing(rules):
    """The base pushes a box, which touches the wall behind it."""
    box = {**BOX, "position": (0.46, 0.0, 0.1), "friction": 0.6}
    wall = {**WALL, "position": (0.712, 0.0, 0.2)}
    engine = {"iterations": 100, "tolerance": 1e-8}  # to the minimum, whichever way
    return make_scene(robot=[PUSHER], object=[box], obstacle=[wall], randomize=rules, engine=engine)


def worlds(scene) -> dict:
    properties = draw_properties(scene, compiled(scene).layout, SAMPLES, seed=3)
    return {"pairs": PAIRS, "properties": properties if scene.randomize else None}


def fused(scene) -> FusedPhysics:
    steps = {"substeps": [2] * HORIZON, "timestep": 0.02}
    return FusedPhysics(scene, compiled(scene), SHAPE, device="cpu", **steps, **worlds(scene))


def controls() -> np.ndarray:
    """Controls that push forward, of every world its own ``[T, W, 3]``."""
    rng = np.random.default_rng(0)
    return rng.uniform([0.4, -0.3, -0.3], [1.0, 0.3, 0.3], size=(HORIZON, SHAPE.worlds, 3)).astype(np.float32)


@WORLDS
def test_every_world_starts_where_the_cloning_kernel_puts_it(rules):
    """Joints, bodies and their velocities, of two environments in different states."""
    scene = pushing(rules)
    layout, physics = compiled(scene).layout, fused(scene)
    rows = [random_state(layout, seed) for seed in range(ENVS)]
    state = observed(*(np.stack(values) for values in zip(*rows, strict=True)))
    physics.clone(state)
    physics.rollout(wp.array(np.zeros((HORIZON, SHAPE.worlds, 3)), dtype=float, device="cpu"))
    found, names = physics.trajectory, ("joint_q", "joint_qd", "body_q", "body_qd")
    expected = {name: wp.zeros_like(getattr(found, name)) for name in names}
    inputs = [joint_table(layout, "cpu"), state.joint_q, state.joint_qd, SHAPE.rollouts, 0]
    wp.launch(clone_state_kernel, dim=SHAPE.worlds, inputs=inputs, outputs=list(expected.values()), device="cpu")
    for name, values in expected.items():
        a, b = getattr(found, name).numpy()[0], values.numpy()[0]
        if name == "body_q":  # a quaternion and its negative are one rotation
            a[..., 3:] *= np.where((a[..., 3:] * b[..., 3:]).sum(axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
        np.testing.assert_allclose(a, b, atol=2e-5, err_msg=name)
        assert np.ptp(b.reshape(ENVS, SAMPLES, -1), axis=0).max() > 0.1
        assert np.ptp(b.reshape(ENVS, SAMPLES, -1), axis=1).max() == 0.0


@WORLDS
def test_every_world_feels_the_forces_that_the_contact_kernels_add_up(rules):
    """Of MuJoCo's C engine by its sensors, of MuJoCo Warp by its contacts; each world has its own draws."""
    scene = pushing(rules)
    layout, control = compiled(scene).layout, wp.array(controls(), dtype=float, device="cpu")
    state = observed(np.tile(layout.joint_q, (ENVS, 1)), np.tile(layout.joint_qd, (ENVS, 1)))
    steps = {"substeps": [2] * HORIZON, "timestep": 0.02}
    options = Options.of(scene.engine)
    warp = MujocoWarpSimulator(scene, compiled(scene), SHAPE, device="cpu", **steps, **worlds(scene))
    c = make_engine(scene, envs=ENVS, samples=SAMPLES, horizon=HORIZON, options=options, **worlds(scene))
    forces = []
    for engine in (fused(scene), c, warp):
        engine.clone(state)
        engine.rollout(control)
        forces.append(engine.trajectory.contact_force.numpy().copy())
    ours, by_sensors, by_contacts = forces
    strength = np.abs(by_sensors).max(axis=(0, 1, 3))
    assert (strength[:3] > 2.0).all()
    np.testing.assert_allclose(ours, by_sensors, atol=0.3)
    np.testing.assert_allclose(ours, by_contacts, atol=0.02 * strength.max())
    weight = by_sensors[0, :, PAIRS.index(Pair("box", "ground")), 2]
    assert bool(rules) == bool(np.ptp(weight) > 2.0)
