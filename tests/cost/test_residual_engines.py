# SPDX-License-Identifier: Apache-2.0
"""Residuals inside the launches of engines: what `fused` sums is what their Warp functions say about its record."""

import numpy as np
from fused_costs import assert_costs, expected_totals, planned
from small_scenes import chain_scene, compiled

from warpmpc import Scene

COM = {"centre_of_mass": "chain"}
COSTS = [
    {"term": "position_residual", "of": COM, "lead": 0.2, "relative_to": ["chain/hand", "chain/head"], "axes": "xy",
     "norm": {"kind": "smooth_abs", "p": 0.1}},
    {"term": "position_residual", "of": "chain/head", "relative_to": ["chain/hand", "chain/arm"], "axes": "z",
     "target": "height", "norm": {"kind": "l22", "p": 0.1, "q": 3.0}},
    {"term": "velocity_residual", "of": COM, "axes": "xy", "norm": {"kind": "cosh", "p": 0.9}},
    {"term": "velocity_residual", "of": {"centre_of_mass": "chain/arm"}, "relative_to": "chain/trunk",
     "target": "speed"},
]  # fmt: skip


def residual_scene(folder, costs=COSTS, **planner) -> Scene:
    """A chain that falls, with every kind of joint."""
    scene = chain_scene(folder)
    keys = scene.model_dump(exclude={"path", "variant"})
    planner = {"samples": 21, "horizon": 5, "discount": 0.9, **planner}
    keys |= {"cost": costs, "scalar": {"height": 0.3, "speed": -0.2}, "planner": planner, "engine": {"threads": 1}}
    return Scene.model_validate(keys).model_copy(update={"path": scene.path})


def test_fused_sums_what_the_warp_functions_say(tmp_path):
    scene = residual_scene(tmp_path)
    mpc = planned(scene, envs=2, compiled=compiled(scene))
    assert not mpc.engine.records
    expected = expected_totals(mpc)
    assert (np.ptp(expected, axis=1) > 1e-3).all()
    assert_costs(mpc, expected, rtol=1e-4)
