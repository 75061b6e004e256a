# SPDX-License-Identifier: Apache-2.0
"""Models of more than 64 degrees of freedom: what all touches one another is solved in loops."""

import mujoco
import numpy as np
import pytest
from fused_models import starts
from fused_steps import public_differences, visit

from warpmpc.physics.unsupported import MOST_DOFS, missing

BALL = """<body pos="{x} {y} {z}"><freejoint/><geom type="{kind}" size="{size}" friction=".6"/></body>"""
CHAIN = '<body pos=".12 0 0"><joint axis="0 {y} {z}" damping=".02" armature=".01"/><geom type="capsule" '
CHAIN += 'fromto="0 0 0 .12 0 0" size=".03"/>{rest}</body>'


def pile(balls: int, links: int) -> mujoco.MjModel:
    """Balls and capsules in a corner, and a chain that lies across them."""
    shapes = [("sphere", ".06"), ("capsule", ".04 .03")]
    parts = [
        BALL.format(x=0.11 * (k % 3), y=0.11 * (k // 3 % 3), z=0.055 + 0.11 * (k // 9), kind=kind, size=size)
        for k, (kind, size) in enumerate(shapes[k % 2] for k in range(balls))
    ]
    rest = ""
    for k in range(links):
        rest = CHAIN.format(y=k % 2, z=1 - k % 2, rest=rest)
    parts.append(rest.replace('pos=".12 0 0"', 'pos="-.3 .1 .25"', 1))
    return mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep=".004" iterations="100" tolerance="1e-10"/><worldbody>'
        '<geom type="plane" size="3 3 .1"/><geom type="plane" size="3 3 .1" pos="-.1 0 0" zaxis="1 0 .3"/>'
        f"{''.join(parts)}</worldbody></mujoco>"
    )


def test_steps_of_a_large_pile_are_those_of_mujoco():
    model = pile(13, 7)
    assert 64 < model.nv <= MOST_DOFS
    worlds, steps = 4, 40
    q, v = starts(model, worlds, seed=1, speed=0.3)
    q[:, 2 : 13 * 7 : 7] += 0.02
    states = visit([model], q, v, np.zeros((steps, worlds, 0)), every=4)
    assert states.contacts.max() > 20
    found = public_differences(model, states)
    steady = states.edge < 1e-4
    assert steady.mean() > 0.7, found
    assert np.median(found.v.max(axis=1)[steady]) <= 1e-5, found
    assert (found.v.max(axis=1) <= 1e-4 + 5.0 * states.edge)[steady].all(), found


@pytest.mark.parametrize(("balls", "links"), [(20, 9), (0, 70)])
def test_too_large_models_are_refused_at_once(balls, links):
    model = pile(balls, links)
    told = missing(model)
    assert told is not None
    assert "degrees of freedom" in told
