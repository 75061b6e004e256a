# SPDX-License-Identifier: Apache-2.0
"""A model's step that is compiled apart from its rollouts: the same bits, and shared by whatever rolls it out."""

import numpy as np
import pytest
from fused_models import CONTACTS, compile_model, controls, starts
from shared.plain_rollout import PlainRollout
from small_scenes import compiled, make_scene

from warpmpc import Controller
from warpmpc.physics.source_parts import make_kernel

WORLDS, STEPS = 21, 30


@pytest.mark.parametrize("seed", range(3))
def test_rollouts_with_their_steps_in_one_source_give_the_same_bits(seed):
    model = compile_model(CONTACTS)
    engine = PlainRollout(model, WORLDS, STEPS)
    q, v = starts(model, WORLDS, seed=seed)
    given = q, v, controls(model, STEPS, WORLDS, seed=seed)
    apart = [array.copy() for array in engine(*given)]
    engine.kernel = make_kernel(engine.source(lanes=engine._lanes, shared=False), engine._lanes, 1)
    for there, here in zip(apart, engine(*given), strict=True):
        np.testing.assert_array_equal(there, here)


def steps_of(**changed):
    scene = make_scene(engine={"name": "fused"}, **changed)
    return Controller(scene, device="cpu", compiled=compiled(scene)).engine.physics._steps


def test_other_terms_and_splines_share_the_step_of_their_model():
    steps = steps_of()
    cost = [{"term": "distance", "between": ["base/centre", "goal"]}, {"term": "joint_velocity", "weight": 0.1}]
    assert steps_of(cost=cost)._kernel is steps._kernel
    assert steps_of(planner={"samples": 32, "horizon": 6, "spline": "cubic"})._kernel is steps._kernel
    heavier = [
        {**robot, "armature": 0.1} for robot in make_scene().model_dump(mode="json", exclude_unset=True)["robot"]
    ]
    assert steps_of(robot=heavier)._kernel is not steps._kernel
