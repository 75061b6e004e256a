# SPDX-License-Identifier: Apache-2.0
"""The engine fused on a GPU, with a warp to a world and with a thread to one: pytest -m gpu tests/engine."""

import mujoco
import numpy as np
import pytest
from needs import CUDA, need
from shared.plain_rollout import PlainRollout

import warpmpc

pytestmark = pytest.mark.gpu

MODEL = """<mujoco>
  <option timestep="0.005" integrator="implicitfast" iterations="50" tolerance="1e-8">
    <flag multiccd="disable"/>
  </option>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body pos="0 0 .3"><freejoint/><geom type="box" size=".1 .15 .1" mass="2"/>
      <body pos=".1 0 0"><joint axis="0 1 0" range="-60 60" damping=".1"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
        <body pos=".3 0 0"><joint axis="0 0 1" range="-40 40" armature=".01"/>
          <geom type="sphere" size=".05" mass=".3"/>
        </body>
      </body>
    </body>
    <body pos=".5 .1 .2"><freejoint/><geom type="box" size=".12 .1 .2" mass="1"/></body>
    <body pos="0 .6 .15"><freejoint/><geom type="cylinder" size=".1 .15" mass="1"/></body>
  </worldbody>
</mujoco>"""
WORLDS, STEPS = 70, 40


@pytest.fixture(scope="module")
def started():
    """A model, and states from which its bodies fall over each other."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    rng = np.random.default_rng(0)
    q = np.tile(model.qpos0, (WORLDS, 1))
    v = rng.normal(size=(WORLDS, model.nv)) * 0.7
    return model, q, v


@pytest.fixture(scope="module", params=[True, False], ids=["warp", "thread"])
def rollout(request, started):
    """Rollouts on the GPU."""
    need(CUDA)
    return PlainRollout(started[0], WORLDS, STEPS, device="cuda:0", share=request.param)


def test_worlds_move_as_mujocos(rollout, started):
    model, q, v = started
    ours, _ = rollout(q, v, np.zeros((STEPS, WORLDS, 0)))
    data = mujoco.MjData(model)
    off, touched = [], 0
    for w in range(WORLDS):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = q[w], v[w]
        for _ in range(STEPS):
            mujoco.mj_step(model, data)
            touched += data.ncon > 0
        off.append(np.abs(ours[-1, w] - data.qpos).max())
    assert touched > WORLDS * STEPS / 4
    assert np.median(off) < 1e-5
    assert np.percentile(off, 90) < 1e-3


def test_the_same_start_gives_the_same_bits(rollout, started):
    _, q, v = started
    nothing = np.zeros((STEPS, WORLDS, 0))
    first = [x.copy() for x in rollout(q, v, nothing)]
    for _ in range(5):
        for a, b in zip(first, rollout(q, v, nothing), strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_poisoned_world_changes_no_other(rollout, started):
    _, q, v = started
    nothing = np.zeros((STEPS, WORLDS, 0))
    clean = rollout(q, v, nothing)[0].copy()
    poisoned = v.copy()
    poisoned[7] = np.nan
    found = rollout(q, poisoned, nothing)[0]
    others = np.arange(WORLDS) != 7
    np.testing.assert_array_equal(found[:, others], clean[:, others])
    assert rollout.work.diverged.numpy().tolist() == [int(w == 7) for w in range(WORLDS)]


@pytest.mark.parametrize("sharing", [32, 1], ids=["warp", "thread"])
@pytest.mark.parametrize("name", ["omni_push_box", "panda_push", "mobile_pick"])
def test_a_plan_on_the_gpu_costs_what_it_does_on_the_cpu(name, sharing):
    """Both where a warp judges its world and where another launch does."""
    need(CUDA)
    samples = 64 if sharing > 1 else 6144
    scene = warpmpc.load_scene(name, overrides=[f"planner.samples={samples}"])
    gpu, cpu = (warpmpc.Controller(scene, engine="fused", device=device, seed=1) for device in ("cuda:0", "cpu"))
    assert gpu.engine.physics.sharing == sharing
    state = warpmpc.State.start(gpu.layout)
    for controller in (gpu, cpu):
        controller.step(state)
    a, b = (controller.engine.cost.numpy() for controller in (gpu, cpu))
    assert np.median(np.abs(a - b) / b) < 1e-4
    a, b = (controller.engine.record(range(64)).body_qd for controller in (gpu, cpu))
    off = np.abs(a - b)
    assert np.median(off) < 1e-4
