# SPDX-License-Identifier: Apache-2.0
"""Where the robot will be when the plan is ready: as the plant goes on, and what that is worth.

Slow ones by hand: pytest -m slow tests/loop/realtime/test_predictor.py
"""

from dataclasses import replace

import numpy as np
import pytest
from small_scenes import compiled, layout_of, make_scene
from studies.plants.latency import delayed_episode

from warpmpc import Controller, Task, load_scene, simulated_robot
from warpmpc.loop.realtime.messages import TimedObservation
from warpmpc.loop.realtime.planning import Planning, Predictor


def turning(time: float, state: object = None) -> np.ndarray:
    return np.array([0.8, 0.5 * np.cos(9.0 * time), -0.6])


def test_a_prediction_is_where_the_plant_goes():
    scene = make_scene(plant={"randomize": False}, agent={"rate": 1000.0})
    robot = simulated_robot(scene, compiled=compiled(scene))
    for _ in range(100):
        robot.apply(turning(robot.time))
    before = robot.observe()
    predictor = Predictor(scene, compiled(scene), layout_of(scene), Task(scene))
    predicted = predictor(before, turning, 0.1)
    while robot.time < predicted.time - 1e-9:
        robot.apply(turning(robot.time))
    assert before.time + 0.1 <= predicted.time + 1e-9 < before.time + 0.1 + predictor.dt
    assert robot.time == pytest.approx(predicted.time)
    moved = np.abs(robot.state.joint_q - before.joint_q)
    assert moved[0] > 0.05
    np.testing.assert_allclose(predicted.joint_q, robot.state.joint_q, atol=0.05 * moved.max())
    again = predictor(before, turning, 0.1)
    np.testing.assert_array_equal(again.joint_q, predicted.joint_q)  # nothing is left from the one before


def test_no_time_ahead_is_the_state_itself_and_so_is_one_that_blows_up():
    scene = make_scene()
    predictor = Predictor(scene, compiled(scene), layout_of(scene), Task(scene))
    state = replace(simulated_robot(scene, compiled=compiled(scene)).observe(), time=1.0)
    assert predictor(state, turning, 0.0) is state
    wild = replace(state, joint_qd=np.full(3, 1e12, dtype=np.float32))
    assert predictor(wild, turning, 0.1) is wild
    np.testing.assert_array_less(predictor(state, turning, 0.1).joint_q[0], 0.1)  # and the next one does not mind


def test_a_plan_is_for_the_time_at_which_it_is_ready():
    scene = make_scene()
    controller = Controller(scene, engine="mujoco", device="cpu", compiled=compiled(scene))
    state = simulated_robot(scene, compiled=compiled(scene)).observe()
    planning = Planning(controller, latency=0.08)
    timed = planning.plan(TimedObservation(state, np.ones(3), following=False))
    assert timed.observed == 0.0
    assert controller.info.time == pytest.approx(0.08)
    nothing = replace(state, joint_q=np.full(3, np.nan))
    assert planning.plan(TimedObservation(nothing, np.ones(3), following=False)) is None
    assert timed.number == 0


@pytest.mark.slow
def test_a_late_plan_swings_the_pole_up_sooner_where_its_lateness_is_known():
    scene = load_scene("cartpole_swingup", overrides=["engine.name=fused", "engine.threads=1"])
    times = {
        compensate: [delayed_episode(scene, latency=0.12, compensate=compensate, seed=seed).time for seed in range(4)]
        for compensate in (True, False)
    }
    assert np.mean(times[True]) < np.mean(times[False])
