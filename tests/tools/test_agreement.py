# SPDX-License-Identifier: Apache-2.0
"""Every shipped scene rolls out alike on both engines: the same states, controls and randomized worlds.

Compiling the kernels of mujoco_warp takes a minute a scene with empty caches, so on the CPU these tests are slow ones:
pytest -m slow tests/tools/test_agreement.py. On a CUDA device: pytest -m gpu tests/tools/test_agreement.py.
"""

import pytest
from benches.agreement import differences
from needs import CUDA, need, need_scene

from warpmpc import load_scene, shipped_scenes
from warpmpc.scene.schema import EngineName

ROUNDING = (2e-5, 2e-4)
"""float32 against float64 over 20 to 60 physics steps: measured up to 2e-6 at p50 and 8e-6 at p90 [m, rad]."""

TOLERANCE = {
    # a touch of two cylinders that one engine makes and the other just misses: measured 4e-7 and 4e-4
    "cylinder_push": (2e-5, 2e-3),
    # in a push a touch that one engine makes and the other just misses moves the box: measured 1e-6 and 7e-5
    "omni_push_box": (2e-5, 2e-3),
    # its wheels and casters touch the ground in every step, and slip: measured 1.3e-4 and 1e-3
    "diff_push_box": (1e-3, 1e-2),
    "omni_push_sphere": ROUNDING,
    # a cylinder lies along a box: the engines choose other points of the line: measured 1.4e-5 and 8.3e-2
    "panda_push": (2e-4, 0.15),
    # the same stick, seldom along a side: measured 5e-7 and 7e-4
    "panda_push_objects": (2e-5, 2e-2),
    # the faces of a gripped cube meet those of the fingers at other points: measured 9e-6 and 0.2, its rotation
    "mobile_pick": (2e-4, 0.5),
    "panda_reach": ROUNDING,
    "panda_reach_pose": ROUNDING,
    "point_reach": ROUNDING,
    "push_t": ROUNDING,
    "humanoid_stand": ROUNDING,
    **dict.fromkeys(("acrobot", "cartpole_swingup", "pendulum", "quadrotor", "walker"), ROUNDING),
    **dict.fromkeys(("g1_walk", "go2_jump", "go2_walk"), ROUNDING),
    # a foot that touches in one engine and just misses in the other: measured 4e-7 and 1e-4
    "quadruped_walk": (2e-5, 2e-3),
    # the same with hands along a box's edges: measured 2e-7 and 3e-3
    "box_carry": (2e-5, 2e-2),
    # it rolls over its arms and legs: measured 6e-7 and 5e-3
    "humanoid_get_up": (2e-5, 5e-2),
    # every foot stands on a heightfield, whose prisms the engines meet at other points: measured 1e-2 and 6e-2
    "quadruped_terrain": (5e-2, 0.3),
    # cubes on cubes, whose faces meet at other points: measured 6e-2, their rotation, and 0.2
    "omni_sweep_cubes": (0.15, 0.5),
    # a cube's edges between capsules, half a dozen touches at a time: measured 8e-4 and 2e-2
    "hand_cube": (5e-3, 0.15),
}
"""Scene → largest difference at the end of the horizon of half and of nine tenths of the worlds [m, rad]."""

FORCE = {"box_carry": 5.0}
"""Scene → largest difference of a contact force in nine tenths of the worlds [N]; two hands press a box: 0.8."""
FORCE_ELSEWHERE = 0.5
"""The same of other scenes: measured up to 0.024 N, on either device."""


@pytest.fixture(params=[pytest.param("cpu", marks=pytest.mark.slow), pytest.param("cuda:0", marks=pytest.mark.gpu)])
def where(request) -> str:
    """Every device in turn."""
    if request.param != "cpu":
        need(CUDA)
    return request.param


def test_every_shipped_scene_has_its_tolerance():
    physics = {name for name in shipped_scenes() if load_scene(name).engine.name is not EngineName.KINEMATIC}
    assert set(TOLERANCE) == physics


@pytest.mark.timeout(900)
@pytest.mark.parametrize("scene", TOLERANCE)
def test_both_engines_roll_a_scene_out_alike(scene, where):
    need_scene(scene)
    found = differences(scene, "mujoco_warp", device=where, samples=32, seconds=8.0, states=6)
    half, most = TOLERANCE[scene]
    for quantity in ("joint_q", "position"):
        assert found[quantity]["p50"][-1] <= half, found
        assert found[quantity]["p90"][-1] <= most, found
    assert found["force"]["p90"][-1] <= FORCE.get(scene, FORCE_ELSEWHERE), found
