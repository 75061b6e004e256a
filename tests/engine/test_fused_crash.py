# SPDX-License-Identifier: Apache-2.0
"""Robots that run into each other: the forces between them are those of the engine `mujoco`."""

import numpy as np
import pytest
import warp as wp
from small_scenes import DISC, make_scene, observed

from warpmpc import Scene
from warpmpc.engine.fused_physics import FusedPhysics
from warpmpc.engine.mujoco import MujocoSimulator
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.pairs import Pair, collision_pairs
from warpmpc.scene.model.trajectory import BatchSize

HAMMER = """
<mujoco><worldbody>
  <geom name="pedestal" type="box" size="0.1 0.1 0.2" pos="0 0 0.2"/>
  <body name="arm" pos="0 0 0.45">
    <joint name="swing" axis="0 0 1" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.04" mass="1"/>
    <body name="head" pos="0.5 0 -0.2"><geom type="box" size="0.06 0.06 0.2" mass="1"/></body>
  </body>
</worldbody><actuator><motor name="swing" joint="swing" ctrlrange="-40 40"/></actuator></mujoco>
"""
WALKER = """
<mujoco><worldbody><body name="trunk" pos="0 0 0.2"><freejoint/>
  <geom type="sphere" size="0.15" mass="2"/>
  <body name="leg" pos="0.15 0 0"><joint name="knee" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.05" mass="0.5"/></body>
</body></worldbody><actuator><motor name="knee" joint="knee" ctrlrange="-5 5"/></actuator></mujoco>
"""
STEPS, SUBSTEPS = 25, 8


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Two discs drive against each other, an arm strikes a ball with a leg."""
    folder = tmp_path_factory.mktemp("crash")
    for name, text in (("hammer.xml", HAMMER), ("walker.xml", WALKER)):
        (folder / name).write_text(text)
    return make_scene(
        robot=[
            {**DISC, "joint_q": (-0.4, -2.0, 0.0)},
            {**DISC, "name": "other", "joint_q": (0.4, -2.0, 0.0)},
            {"name": "hammer", "asset": str(folder / "hammer.xml")},
            {"name": "walker", "asset": str(folder / "walker.xml"), "position": (0.5, 0.3, 0.15)},
        ],
        cost=[{"term": "contact_force", "between": ["base", "other"]}],
        planner={"samples": 4, "horizon": STEPS, "noise": {"sigma": 0.1}},
        engine={"threads": 1},
    )


PAIRS = (Pair("base", "other"), Pair("other", "base"), Pair("hammer", "walker"), Pair("walker", "hammer"))


def test_forces_between_robots_are_those_of_mujoco(scene):
    compiled = compile_scene(scene)
    assert set(PAIRS[::2]) <= set(collision_pairs(compiled.layout))
    layout, shape = compiled.layout, BatchSize(1, 1, 1, STEPS)
    control = np.zeros((STEPS, 1, layout.nu), dtype=np.float32)
    control[:, 0, 0], control[:, 0, 3], control[:, 0, 6] = 1.0, -1.0, 40.0
    options = {"substeps": [SUBSTEPS] * STEPS, "timestep": scene.timing.control_dt / SUBSTEPS, "pairs": PAIRS}
    forces = []
    for engine in (
        MujocoSimulator(compiled, shape, threads=1, **options),
        FusedPhysics(scene, compiled, shape, **options),
    ):
        engine.clone(observed(layout.joint_q, layout.joint_qd))
        engine.rollout(wp.array(control, dtype=float))
        forces.append(engine.trajectory.contact_force.numpy()[:, 0])
    expected, found = forces
    for force in forces:
        np.testing.assert_allclose(force[:, 1::2], -force[:, ::2], atol=1e-3)
    for pair, axis in ((0, 0), (2, 1)):  # along the blow; MuJoCo's contacts of two cylinders slip to either side
        theirs, ours = expected[:, pair, axis], found[:, pair, axis]
        first = np.flatnonzero(theirs)[0]
        assert np.abs(theirs).max() > 100.0
        assert not ours[:first].any()
        assert ours[first] == pytest.approx(theirs[first], rel=0.02)
        assert ours.sum() == pytest.approx(theirs.sum(), rel=0.05)
