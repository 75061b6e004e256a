# SPDX-License-Identifier: Apache-2.0
"""Contact forces: which number belongs to which pair and step, and whom a force acts on."""

import numpy as np
import pytest
import warp as wp

from warpmpc.kernels.worlds.contacts import mujoco_contact_force_kernel


@pytest.mark.parametrize(("substeps", "pairs"), [(1, 1), (3, 2)])
def test_forces_are_means_over_the_physics_steps_on_the_first_of_the_pair(substeps, pairs, device):
    worlds, steps = 3, 4
    # the sensor measures the force on the second side
    on_second = np.random.default_rng(substeps).normal(size=(worlds, steps * substeps, pairs, 3))
    force = wp.zeros((steps, worlds, pairs), dtype=wp.vec3, device=device)
    sensor = wp.array(on_second.reshape(worlds, -1, 3 * pairs), dtype=wp.float64, device=device)
    wp.launch(
        mujoco_contact_force_kernel, dim=(steps, worlds), inputs=[sensor, substeps], outputs=[force], device=device
    )
    expected = -on_second.reshape(worlds, steps, substeps, pairs, 3).mean(axis=2).swapaxes(0, 1)
    np.testing.assert_allclose(force.numpy(), expected, atol=1e-6)
