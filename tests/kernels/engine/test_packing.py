# SPDX-License-Identifier: Apache-2.0
"""What crosses between host and device: where every number goes, failures counted, capacity bits in two halves."""

import numpy as np
import pytest
import warp as wp

from warpmpc.kernels.engine.packing import REPORT, report_kernel, survey_kernel, unpack_kernel

HIGH, LOW = 1 << 30 | 1 << 17, 1 << 2 | 1


def failures(diverged, overflow, *, envs: int, device: str) -> np.ndarray:
    """Diverged worlds and capacity bits of every environment ``[E, 2]``."""
    out = wp.full((envs, 2), 77, dtype=int, device=device)
    best = [wp.zeros(envs, dtype=kind, device=device) for kind in (int, float)]
    inputs = [wp.array(a, dtype=int, device=device) for a in (diverged, overflow)]
    cost = wp.zeros((envs, 2), dtype=float, device=device)
    launch = {"dim": [envs], "block_dim": 64, "device": device}
    wp.launch_tiled(survey_kernel, inputs=[cost, *inputs], outputs=[*best, out], **launch)
    return out.numpy()


def test_capacity_bits_of_all_worlds_of_an_environment_count(device):
    diverged, overflow = [0, 1, 1, 0, 0, 3], [1, 4, 0, 2, 2, HIGH]
    found = failures(diverged, overflow, envs=2, device=device)
    assert found.tolist() == [[2, 5], [1, HIGH | 2]]


@pytest.mark.parametrize("bits", [0, 1, 0xFFFF, 0x10000, LOW | HIGH, 0x7FFFFFFF])
def test_capacity_bits_survive_the_way_through_floats(bits, device):
    def zeros(*shape: int, dtype: type = float) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=device)

    nu, terms, knots = 2, 3, 4
    failed = wp.array([[7, bits]], dtype=int, device=device)
    report = zeros(1, nu + int(REPORT) + terms + knots * nu + 1)
    inputs = [zeros(1, nu), zeros(1), zeros(1), zeros(1, dtype=int), zeros(1), failed]
    inputs += [zeros(1, terms), zeros(1, knots, nu), zeros(1)]
    wp.launch(report_kernel, dim=(1, 3), inputs=[*inputs, 3], outputs=[report], device=device)
    row = report.numpy()[0]
    assert row[nu + 4] == 7.0
    assert int(row[nu + 5]) | int(row[nu + 6]) << 16 == bits


def test_a_report_holds_command_numbers_terms_knots_and_offset_in_this_order(device):
    rng = np.random.default_rng(0)
    nu, terms, knots = 2, 3, 4
    command, beta, eta, cost = rng.normal(size=(2, nu)), rng.normal(size=2), rng.normal(size=2), rng.normal(size=2)
    term, mean, offset = rng.normal(size=(2, terms)), rng.normal(size=(2, knots, nu)), rng.normal(size=2)

    def on(values, dtype: type = float) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    report = wp.zeros((2, nu + int(REPORT) + terms + knots * nu + 1), dtype=float, device=device)
    inputs = [on(command), on(beta), on(eta), on([5, 6], int), on(cost), on([[1, 2], [3, 4]], int)]
    inputs += [on(term), on(mean), on(offset), 3]
    wp.launch(report_kernel, dim=(2, 3), inputs=inputs, outputs=[report], device=device)
    for e in range(2):
        numbers = [beta[e], eta[e], cost[e], [5, 6][e], [1, 3][e], [2, 4][e], 0.0]
        expected = np.concatenate([command[e], numbers, term[e], mean[e].ravel(), offset[e : e + 1]])
        np.testing.assert_allclose(report.numpy()[e], expected, rtol=1e-6)


def test_a_packed_row_is_taken_apart_in_order(device):
    sizes = {"joint_q": 4, "joint_qd": 3, "act": 2, "mocap": 7, "proposed": 6, "pose": 21, "scalar": 2, "weight": 5}
    packed = np.random.default_rng(0).normal(size=(2, 3 + sum(sizes.values()))).astype(np.float32)
    packed[:, 0] = [1.0, 0.0]
    out = [wp.zeros(2, dtype=int, device=device), *(wp.zeros(2, dtype=float, device=device) for _ in range(2))]
    out += [wp.zeros((2, n), dtype=float, device=device) for n in sizes.values()]
    source = wp.array(packed, dtype=float, device=device)
    wp.launch(unpack_kernel, dim=packed.shape, inputs=[source], outputs=out, device=device)
    assert out[0].numpy().tolist() == [1, 0]
    found = np.concatenate([array.numpy().reshape(2, -1) for array in out[1:]], axis=1)
    np.testing.assert_array_equal(found, packed[:, 1:])
