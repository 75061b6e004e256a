# SPDX-License-Identifier: Apache-2.0
"""An arm among things that a camera sees from one side: what is hidden from it is not taken for free.

Slow ones by hand: pytest -m slow tests/scenes/test_storm_cloud.py
"""

import numpy as np
import pytest
from studies.arms.clutter import run

import warpmpc
from warpmpc import Controller, Plant

HIDDEN = np.array([0.86, 0.08, 0.22])
"""A place on the shelf's back [m] that its board hides from the camera: clutter 199 ran into it."""


@pytest.mark.parametrize("behind", [0.0, None])
def test_what_the_board_hides_counts_as_filled(behind):
    overrides = ["planner.samples=64"] + ([] if behind is None else [f"cloud.seen.behind={behind}"])
    scene = warpmpc.load_scene("storm_cloud", overrides=overrides)
    mpc = Controller(scene, device="cpu", seed=199)
    plant = Plant(scene, seed=199, task=mpc.task)
    mpc.step(plant.observe())
    points = mpc.task["seen"]
    assert np.linalg.norm(points - HIDDEN, axis=1).min() > 0.03
    (clouds,) = (resource for resource in mpc.costs.resources if hasattr(resource, "volumes"))
    cloud = scene.cloud[0]
    x, y, z = ((HIDDEN - np.array(cloud.low)) / cloud.voxel).astype(int)
    distance = clouds.volumes["seen"].distance[0, z, y, x]
    assert (distance <= cloud.voxel) == (behind is None)


@pytest.mark.slow
def test_nothing_is_touched_in_the_clutter_that_once_was():
    record = run(199, ["engine.threads=1"], 0.04)
    assert record["counts"]
    assert not record["touched"]
    assert record["position_mm"] < 30.0
