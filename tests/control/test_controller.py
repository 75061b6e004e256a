# SPDX-License-Identifier: Apache-2.0
"""The controller: it reaches its goal, repeats itself, and stays safe when nothing survives."""

import logging

import numpy as np
import pytest
from small_scenes import BOX, DISC, compiled, make_scene

from warpmpc import (
    Controller,
    Plant,
    SceneError,
    State,
    array_cost,
)

SMALL = {"samples": 16, "horizon": 4}


def make_controller(*, seed: int = 0, terms=(), **sections) -> Controller:
    scene = make_scene(**{"planner": SMALL, **sections})
    return Controller(scene, seed=seed, terms=terms, compiled=compiled(scene))


def start(controller: Controller) -> State:
    return State.start(controller.layout)


@pytest.mark.parametrize("method", ["mppi", "predictive_sampling", "cem"])
def test_it_brings_the_disc_to_its_goal(method):
    planner = {"method": method, "samples": 48, "horizon": 8, "temperature": {"initial": 0.1}, "sigma_min": (0.1,)}
    scene = make_scene(planner=planner)
    controller = Controller(scene, compiled=compiled(scene))
    plant = Plant(scene, compiled=compiled(scene))
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
    assert plant.reason == "goal reached"
    assert plant.time < 3.0
    info = controller.info
    assert not info.fallback
    assert info.time == pytest.approx(plant.time - 0.04)
    assert info.diverged_worlds == 0
    assert info.plan_ms > 0.0
    assert set(info.stages_ms) == {"clone", "sample", "rollout", "cost", "weigh"}
    assert info.cost == pytest.approx(sum(info.terms.values()), rel=1e-4)


def test_the_same_seed_gives_the_same_commands_and_reset_starts_over():
    cost = {"term": "distance", "between": ["base/centre", "box"], "metric": "geodesic"}
    wall = {"name": "wall", "shape": "box", "size": (0.2, 1.0, 0.4), "position": (1.0, 0.0, 0.2)}
    sections = {"object": [{**BOX, "position": (2.0, 0.0, 0.1)}], "obstacle": [wall], "cost": [cost]}

    def commands(controller: Controller) -> np.ndarray:
        out = []
        for i in range(10):
            state = start(controller)
            state.joint_q[3] += 0.02 * i  # the box moves, and with it its distance field
            out.append(controller.step(state))
        return np.array(out)

    first = make_controller(seed=3, **sections)
    once = commands(first)
    np.testing.assert_array_equal(once, commands(make_controller(seed=3, **sections)))
    assert not np.array_equal(once, commands(make_controller(seed=4, **sections)))
    first.reset()
    assert first.info is None
    np.testing.assert_array_equal(once, commands(first))


def drive(mode: str, **keys) -> dict:
    common = {"velocity": {"damping": 300.0}, "position": {"stiffness": 500.0, "damping": 50.0}, "effort": {}}
    return {"mode": mode, "effort_limit": 50.0, **common[mode], **keys}


DRIVES = {
    "velocity": drive("velocity", limit=(1.0,)),
    "position": drive("position", lower=(-2.0,), upper=(2.0,)),
    "effort": drive("effort", limit=(20.0,)),
}


def blow_up(controller: Controller) -> None:
    """Make every rollout of the controller diverge."""
    rollout = controller.engine.rollout

    def poisoned(control):
        control.numpy()[1:] = 1e30
        rollout(control)

    controller.engine.rollout = poisoned


@pytest.mark.parametrize("why", ["diverged", "nan", "inf"])
@pytest.mark.parametrize("mode", DRIVES)
def test_when_nothing_survives_it_sends_the_safe_command(mode, why, caplog):
    controller = make_controller(robot=[{**DISC, "drive": DRIVES[mode]}])
    state = State(np.array([0.3, -0.4, 3.0], np.float32), np.array([0.2, 0.1, 0.0], np.float32), time=0.4)
    controller.step(state)
    assert not controller.info.fallback
    bad = state
    if why == "diverged":
        blow_up(controller)
    else:
        q = state.joint_q.copy()
        q[1] = {"nan": np.nan, "inf": np.inf}[why]
        bad = State(q, state.joint_qd, time=0.44)
    with caplog.at_level(logging.WARNING, logger="warpmpc"):
        command = controller.step(bad)
    safe = [0.3, -0.4, 2.0] if mode == "position" else [0.0, 0.0, 0.0]  # within its limits
    np.testing.assert_allclose(command, safe, atol=1e-6)
    np.testing.assert_array_equal(controller.costs.last_control.numpy()[0], command)
    assert controller.info.fallback
    assert controller.info.cost == np.inf
    assert controller.info.eta == 0.0
    assert "sending the safe command" in caplog.text
    assert ("diverged" if why == "diverged" else "not finite") in caplog.text
    if why == "diverged":
        assert controller.info.diverged_worlds == controller.shape.worlds


def test_it_recovers_from_a_bad_observation():
    controller, other = make_controller(), make_controller()
    state = start(controller)
    bad = State(np.full(3, np.nan, np.float32), state.joint_qd)
    controller.step(bad)
    for _ in range(3):
        np.testing.assert_array_equal(controller.step(state), other.step(state))
    assert not controller.info.fallback


def test_a_cost_that_is_nowhere_finite_is_a_fallback_too():
    terms = [array_cost("nothing")(lambda batch: np.full(batch["control"].shape[:2], np.nan))]
    controller = make_controller(terms=terms, cost=[{"term": "nothing"}])
    np.testing.assert_array_equal(controller.step(start(controller)), 0.0)
    assert controller.info.fallback
    assert controller.info.diverged_worlds == 0


@pytest.mark.parametrize("shape", [(2, 3), (3, 4), (1,)])
def test_a_state_of_the_wrong_shape_is_refused(shape):
    controller = make_controller()
    q, qd = (np.zeros(n) for n in (shape * 2)[:2])
    with pytest.raises(ValueError, match=r"joint_q \[3\] and joint_qd \[3\]"):
        controller.step(State(q, qd))


def test_the_goal_can_be_moved():
    controller = make_controller(planner={"samples": 48, "horizon": 6, "temperature": {"initial": 0.05}})
    for x in (5.0, -5.0):
        controller.set_goal(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
        for _ in range(12):
            command = controller.step(start(controller))
        assert np.sign(command[0]) == np.sign(x)
        assert abs(command[0]) > 0.4


@pytest.mark.parametrize("pose", [np.zeros(3), np.full(7, np.nan), np.zeros((1, 7)), np.zeros(7)])
def test_a_goal_that_is_no_pose_is_refused(pose):
    controller = make_controller()
    with pytest.raises(ValueError, match="a goal is a pose"):
        controller.set_goal(pose)


@pytest.mark.parametrize(("keys", "message"), [({"engine": "bullet"}, "bullet"), ({"device": "cuda:9"}, "cuda:9")])
def test_an_engine_or_device_that_is_not_there_is_named(keys, message):
    scene = make_scene()
    with pytest.raises(ValueError, match=message):
        Controller(scene, compiled=compiled(scene), **keys)


def test_a_mistake_in_the_costs_shows_at_construction():
    with pytest.raises(SceneError, match="Did you mean 'base/centre'"):
        make_controller(cost=[{"term": "distance", "between": ["base/center", "goal"]}])
