# SPDX-License-Identifier: Apache-2.0
"""Terms that carry numbers along a rollout: users' own, and the ball on a tray."""

import numpy as np
import pytest
import warp as wp
from needs import CUDA, need
from rollouts import Rollouts
from scipy.spatial.transform import Rotation

import warpmpc
from warpmpc import Controller, SceneError, State
from warpmpc.cost.stack import CostEvaluator
from warpmpc.scene.model.trajectory import BatchSize

BALL = {"term": "rolling_ball", "ball": "ball", "on": "panda/centre"}


@wp.struct
class OdometerParams:
    memory: int
    joint: int


def drive_on(s: warpmpc.StepView, p: OdometerParams):
    if s.t == 0:
        warpmpc.remember(s, p.memory, 0.0)
        warpmpc.remember(s, p.memory + 1, warpmpc.joint_position(s, p.joint))
    else:
        here = warpmpc.joint_position(s, p.joint)
        there = warpmpc.joint_position(warpmpc.step_before(s), p.joint)
        warpmpc.remember(s, p.memory, warpmpc.memory_before(s, p.memory) + wp.abs(here - there))
        warpmpc.remember(s, p.memory + 1, wp.max(warpmpc.memory_before(s, p.memory + 1), here))


@warpmpc.cost_term("odometer", advance=drive_on, numbers=2)
def odometer(s: warpmpc.StepView, p: OdometerParams) -> float:
    return warpmpc.memory(s, p.memory)


@wp.struct
class PeakParams:
    memory_of: int


@warpmpc.cost_term("peak")
def peak(s: warpmpc.StepView, p: PeakParams) -> float:
    return warpmpc.memory(s, p.memory_of + 1)


TERMS = [odometer, peak]


def test_numbers_go_along_every_rollout_and_other_terms_read_them():
    first = {"term": "odometer", "name": "x", "joint": "x"}
    second = {"term": "odometer", "name": "y", "joint": "y", "weight": 0.0}  # off, but others read it
    rollouts = Rollouts(first, second, {"term": "peak", "memory_of": "y"}, terms=TERMS)
    q = rollouts.trajectory.joint_q.numpy().astype(float)
    np.testing.assert_allclose(rollouts.cost(0), np.abs(np.diff(q[..., 0], axis=0)).cumsum(axis=0), rtol=1e-5)
    np.testing.assert_array_equal(rollouts.cost(1), 0.0)
    np.testing.assert_allclose(rollouts.cost(2), np.maximum.accumulate(q[..., 1])[1:], rtol=1e-5)


def test_only_numbers_of_terms_above_can_be_read():
    with pytest.raises(SceneError, match=r"cost\.peak\.memory_of: .*above this one"):
        Rollouts({"term": "peak", "memory_of": "odometer"}, {"term": "odometer", "joint": "x"}, terms=TERMS)


def test_what_carries_numbers_needs_a_place_for_them():
    def on(s: warpmpc.StepView, p: PeakParams):
        return

    def value(s: warpmpc.StepView, p: PeakParams) -> float:
        return 0.0

    for numbers in (0, 2):
        with pytest.raises(TypeError, match=r"cost term 'x': .*memory: int"):
            warpmpc.cost_term("x", advance=on, numbers=numbers)(value)


def balancing(*, seed: int = 0, device: str = "cpu", gravity=(0.0, 0.0, -9.81), **ball):
    """A controller after two plans from a moving start, with a term that has source beside the ball."""
    scene = warpmpc.load_scene("storm_balance", overrides=["planner.samples=37", "planner.noise.sigma=1.0"])
    scene = scene.model_copy(update={"engine": scene.engine.model_copy(update={"gravity": gravity})})
    rows = [cost for cost in scene.cost if cost.term == "pose"]
    rolling = type(rows[0]).model_validate({**BALL, **ball})
    scene = scene.model_copy(update={"cost": (rolling, *rows)})
    mpc = Controller(scene, device=device, seed=seed)
    rng, layout = np.random.default_rng(seed), mpc.layout
    q, qd = layout.joint_q.copy(), rng.normal(0.0, 0.3, layout.nv)
    q[:7] += rng.normal(0.0, 0.1, 7)
    for _ in range(2):  # what the plan before carried is forgotten
        mpc.step(State(q, qd))
    return mpc, q, qd


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def test_the_kinematic_engine_carries_what_the_plain_kernels_carry(device):
    if device != "cpu":
        need(CUDA)
    for seed in range(2):
        mpc, _, _ = balancing(seed=seed, device=device)
        engine, shape = mpc.engine, mpc.shape
        assert engine.records
        trajectory = engine.rollouts(range(shape.worlds))
        whole = BatchSize(1, shape.samples, 1, shape.horizon)
        evaluator = CostEvaluator(mpc.costs, trajectory, trajectory.control, engine.state, whole, mpc.plan_step.grid.t)
        evaluator.launch()
        expected = (evaluator.cost.numpy() * mpc.plan_step.grid.discount[None, :, None]).sum(axis=1)
        assert np.ptp(expected[0]) > 0.1
        np.testing.assert_allclose(engine.total.numpy(), expected, rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize(("carried", "gravity"), [(True, (0.0, 0.0, -9.81)), (False, (0.5, -1.0, -1.62))])
def test_a_ball_rolls_as_its_equation_says(carried, gravity):
    mpc, q, qd = balancing(seed=3, share=0.6, carried=carried, time=0.4, gravity=gravity)
    layout, worlds = mpc.layout, [0, 5, 36]
    out = mpc.engine.record(worlds)
    frame = layout.frame("panda/centre")
    body, offset = int(layout.frame_body[frame]), layout.frame_pose[frame][:3].astype(float)
    dt = np.diff(mpc.plan_step.grid.t)
    for w in range(len(worlds)):
        pose, twist = out.body_q[:, w, body].astype(float), out.body_qd[:, w, body].astype(float)
        turn = Rotation.from_quat(pose[:, 3:])
        origin = pose[:, :3] + turn.apply(offset)
        arm = turn.apply(offset - layout.body_com[body])
        speed = twist[:, :3] + np.cross(twist[:, 3:], arm)
        away = q[7:10] - origin[0]
        x = turn[0].inv().apply(away)[:2]
        v = turn[0].inv().apply(qd[7:10] - speed[0] - np.cross(twist[0, 3:], away))[:2]
        total = 0.0
        for t in range(len(dt)):
            pull = np.array(gravity) - carried * (speed[t + 1] - speed[t]) / dt[t]
            v = v + 0.6 * dt[t] * turn[t + 1].inv().apply(pull)[:2]
            x = x + dt[t] * v
            total += mpc.plan_step.grid.discount[t] * (x @ x + 0.16 * v @ v)
        assert mpc.engine.total.numpy()[0, worlds[w]] == pytest.approx(total, rel=2e-3)


def test_only_balls_that_are_there_roll():
    scene = warpmpc.load_scene("storm_balance", overrides=["planner.samples=16"])
    cube = scene.object[0].model_copy(update={"shape": "box", "size": (0.03, 0.03, 0.03)})
    with pytest.raises(SceneError, match="only spheres roll"):
        Controller(scene.model_copy(update={"object": (cube,)}), device="cpu")
    with pytest.raises(SceneError, match=r"cost\.rolling_ball\.ball"):
        Rollouts({"term": "rolling_ball", "ball": "box", "on": "base/tip"})
    with pytest.raises(SceneError, match="no such object"):
        Rollouts({"term": "rolling_ball", "ball": "base", "on": "base/tip"})
