# SPDX-License-Identifier: Apache-2.0
"""What a warp of a GPU does, lane by lane on the CPU: the same as registers do, whichever lane comes first."""

import numpy as np
import pytest
from fused_models import CONTACTS, DYNAMICS, compile_model, controls, starts
from warp_lanes import COMPILER, LaneRollout

from warpmpc.engine.fused.plain import PlainRollout

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs g++")
WORLDS, STEPS = 4, 12


@pytest.mark.parametrize("text", [DYNAMICS, CONTACTS], ids=["dynamics", "contacts"])
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_lanes_agree_with_registers(text, integrator, tmp_path_factory):
    model = compile_model(text, integrator)
    q, v = starts(model, WORLDS, seed=3)
    control = controls(model, STEPS, WORLDS, seed=3)
    expected = [x.copy() for x in PlainRollout(model, WORLDS, STEPS)(q, v, control)]
    lanes = LaneRollout(model, WORLDS, STEPS, folder=tmp_path_factory.getbasetemp())
    found = []
    for order in (0, 2, 4 * 5 + 1):  # a missing synchronization shows as a result that depends on who comes first
        lanes.order = order
        found.append([x.copy() for x in lanes(q, v, control)])
    for other in found[1:]:
        for x, y in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(x, y)
    for x, y in zip(found[0], expected, strict=True):
        np.testing.assert_allclose(x, y, atol=2e-3)
