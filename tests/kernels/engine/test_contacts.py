# SPDX-License-Identifier: Apache-2.0
"""Contact forces: which number belongs to which pair and step, and whom a force acts on."""

import numpy as np
import pytest
import warp as wp

from warpmpc.kernels.engine.contacts import mujoco_contact_force_kernel


@pytest.mark.parametrize(("substeps", "pairs"), [(1, 1), (3, 2)])
def test_forces_are_means_over_the_physics_steps_on_the_first_of_the_pair(substeps, pairs, device):
    worlds, steps = 3, 4
    # the sensor measures the force on the second side
    on_second = np.random.default_rng(substeps).normal(size=(worlds, steps * substeps, pairs, 3))
    force = wp.zeros((steps, worlds, pairs), dtype=wp.vec3, device=device)
    # every pair has two sensors whose forces add up, behind two numbers of another sensor
    parts = np.stack([0.25 * on_second, 0.75 * on_second], axis=3).reshape(worlds, steps * substeps, 6 * pairs)
    shown = np.concatenate([np.full((worlds, steps * substeps, 2), 99.0), parts], axis=2)
    sensor = wp.array(shown, dtype=wp.float64, device=device)
    start = wp.array(2 + 6 * np.arange(pairs + 1), dtype=int, device=device)
    end = wp.array(substeps * np.arange(1, steps + 1) - 1, dtype=int, device=device)
    inputs = [sensor, start, end, 0]
    wp.launch(mujoco_contact_force_kernel, dim=worlds, inputs=inputs, outputs=[force], device=device)
    expected = -on_second.reshape(worlds, steps, substeps, pairs, 3).mean(axis=2).swapaxes(0, 1)
    np.testing.assert_allclose(force.numpy(), expected, atol=1e-6)


def test_steps_of_different_length_have_means_of_their_own(device):
    counts = np.array([1, 3, 2])
    on_second = np.random.default_rng(0).normal(size=(4, counts.sum(), 2, 3))
    force = wp.zeros((3, 4, 2), dtype=wp.vec3, device=device)
    sensor = wp.array(on_second.reshape(4, -1, 6), dtype=wp.float64, device=device)
    start, end = (wp.array(a, dtype=int, device=device) for a in ([0, 3, 6], np.cumsum(counts) - 1))
    wp.launch(mujoco_contact_force_kernel, dim=3, inputs=[sensor, start, end, 1], outputs=[force], device=device)
    first = 0
    for t, count in enumerate(counts):
        mean = on_second[:, first : first + count].mean(axis=1)
        np.testing.assert_allclose(force.numpy()[t, 1:], -mean[1:], atol=1e-6)
        first += count
    assert np.all(force.numpy()[:, 0] == 0.0)  # worlds before the first are another thread's
