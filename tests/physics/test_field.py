# SPDX-License-Identifier: Apache-2.0
"""Shapes on a heightfield, against MuJoCo C: single steps from visited states, and where they come to rest."""

import mujoco
import numpy as np
import pytest
from fused_models import controls, starts
from fused_steps import step_differences, visit
from shared.plain_rollout import PlainRollout

from warpmpc.physics import unsupported as fused_missing

HEIGHTS = np.random.default_rng(0).uniform(0.0, 1.0, (9, 10))
STONE = np.random.default_rng(1).normal(size=(14, 3))
STONE = 0.12 * STONE / np.linalg.norm(STONE, axis=1, keepdims=True)
GEOMS = {
    "sphere": 'type="sphere" size=".1"',
    "capsule": 'type="capsule" size=".06 .1"',
    "ellipsoid": 'type="ellipsoid" size=".1 .07 .12"',
    "cylinder": 'type="cylinder" size=".08 .1"',
    "box": 'type="box" size=".08 .1 .06"',
    "mesh": 'type="mesh" mesh="stone"',
}


def numbers(values) -> str:
    return " ".join(f"{x:.4f}" for x in np.ravel(values))


def landscape(*kinds: str) -> mujoco.MjModel:
    """Hills of 15 cm with bodies that fall on them and do not meet one another."""
    bodies = "".join(
        f'<body pos="{0.5 * n - 0.9} {0.3 * n - 0.5} 0.3"><freejoint/><geom {GEOMS[kind]} mass="1"/></body>'
        for n, kind in enumerate(kinds)
    )
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="0.004" integrator="implicitfast"/>
<asset><hfield name="hills" nrow="9" ncol="10" size="1.4 1 .15 .2" elevation="{numbers(HEIGHTS)}"/>
<mesh name="stone" vertex="{numbers(STONE)}"/></asset><default><geom contype="2" conaffinity="1"/></default>
<worldbody><geom type="hfield" hfield="hills" contype="1" conaffinity="2" friction=".8" quat="1 .02 .01 .1"/>{bodies}
</worldbody></mujoco>""")


def steps(model: mujoco.MjModel, seed: int = 0):
    """Single steps of a model; those from steady states, the largest difference of each."""
    q, v = starts(model, 8, seed=seed)
    states = visit([model], q, v, controls(model, 100, 8), every=4)
    assert (states.rows > 0).mean() > 0.4
    found = step_differences(model, states, lanes=4)
    print(f"\n{found}")
    return found.v.max(axis=1)[states.edge < 1e-4]


@pytest.mark.parametrize("seed", range(2))
def test_single_steps_of_round_shapes_on_hills_are_those_of_mujoco(seed):
    most = steps(landscape("sphere", "capsule"), seed)
    assert np.median(most) < 1e-6
    assert np.percentile(most, 99) < 1e-4
    assert most.max() < 1e-3


def test_shapes_that_mujoco_iterates_on_agree_within_its_tolerance():
    most = steps(landscape("ellipsoid", "cylinder"))
    assert np.median(most) < 1e-3
    assert np.percentile(most, 95) < 2e-2


def test_boxes_and_stones_on_hills_go_as_in_mujocos_older_collision():
    # the newer one gives edges normals along which they are not nearest to one another
    model = landscape("box", "mesh")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-9, 200
    most = steps(model)
    assert np.median(most) < 1e-2
    assert np.percentile(most, 95) < 0.2


def test_boxes_and_stones_come_to_rest_on_hills():
    model = landscape("box", "mesh")
    worlds, count = 32, 200
    q, v = starts(model, worlds, speed=0.3)
    engine = PlainRollout(model, worlds, count, lanes=4)
    end = engine(q, v, np.zeros((count, worlds, 0)))[0][-1]
    assert not engine.work.overflow.numpy().any()
    data, expected = mujoco.MjData(model), []
    for w in range(worlds):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = q[w], v[w]
        for _ in range(count):
            mujoco.mj_step(model, data)
        expected.append(data.qpos.copy())
    away = np.linalg.norm((np.array(expected) - end).reshape(worlds, -1, 7)[..., :3], axis=-1)
    assert np.median(away) < 0.06
    assert np.abs((np.array(expected) - end)[:, 2::7].mean(axis=0)).max() < 0.02


def test_neighbours_over_other_cells_change_no_bit():
    model = landscape("sphere", "box", "cylinder")
    q, v = starts(model, 24)
    q[:, 0::7] += np.random.default_rng(2).uniform(-0.3, 0.3, (24, 3))
    engine = PlainRollout(model, 24, 60, lanes=4)
    idle = np.zeros((60, 24, 0))
    clean = [x.copy() for x in engine(q, v, idle)]
    order = np.random.default_rng(0).permutation(24)
    for x, y in zip(clean, engine(q[order], v[order], idle), strict=True):
        np.testing.assert_array_equal(x[:, order], y)


def test_hills_are_no_part_of_the_source():
    model, other = landscape("sphere"), landscape("sphere")
    other.hfield_data[:] *= 0.5
    assert fused_missing.missing(model) is None
    sources = [PlainRollout(m, 1, 1).kernel.module.name for m in (model, other)]
    assert sources[0] == sources[1]
