# SPDX-License-Identifier: Apache-2.0
"""Every solver of the engine ``newton`` steps a small scene, moves it as told, and blows nothing up."""

import numpy as np
import pytest
from small_scenes import DISC, compiled, make_scene

from warpmpc import Controller, State
from warpmpc.scene.schema import Solver

SOFT = {**DISC["drive"], "damping": 2.0}


@pytest.mark.parametrize("solver", Solver)
def test_every_solver_steps_a_driven_disc(solver):
    scene = make_scene(
        robot=[{**DISC, "drive": SOFT}],
        ground=None,
        engine={"name": "newton", "solver": str(solver), "substeps": 16},
        planner={"samples": 6, "horizon": 4, "noise": {"sigma": (0.5,)}},
    )
    controller = Controller(scene, engine="newton", device="cpu", compiled=compiled(scene))
    layout = controller.layout
    state = State(layout.joint_q.copy(), np.array([0.3, 0.0, 0.0], np.float32))
    for _ in range(2):
        command = controller.step(state)
    assert np.isfinite(command).all()
    assert not controller.info.fallback
    assert controller.info.diverged_worlds == 0
    q = controller.engine.simulator.trajectory.joint_q.numpy()
    np.testing.assert_allclose(q[0], np.tile(state.joint_q, (6, 1)))
    assert np.isfinite(q).all()
    assert np.abs(q[-1] - q[0]).max() > 1e-3  # they moved,
    assert np.abs(q[-1]).max() < 1.0  # and not far
    assert np.ptp(q[-1], axis=0)[:2].min() > 1e-4  # each sample its own way
