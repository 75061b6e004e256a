# SPDX-License-Identifier: Apache-2.0
"""Samples that a run remembers: what followed states like the observed one is tried again."""

import numpy as np
import pytest
from small_scenes import compiled, make_scene

from warpmpc import Controller, SceneError, State
from warpmpc.scene.model.compiled import compile_scene

DT, STEPS, FIRST = 0.04, 8, 2  # after the mean and the null particle
LAP = 20
"""Plans until the robot is where it was."""


def controller_with(*, envs: int = 1, planner: dict | None = None, **recall) -> Controller:
    table = {"recall": 10.0, "splice": 0.0, **recall}
    more = {"samples": 24, "horizon": STEPS, "noise": {"sigma": (0.5,)}, "randomize": False, **(planner or {})}
    scene = make_scene(planner={**more, "ancillary": [table]}, engine={"threads": 1})
    return Controller(scene, envs=envs, compiled=compiled(scene))


def place(i: int) -> tuple[np.ndarray, np.ndarray]:
    """State of plan i on a lap round a circle that moves on, (x, y, yaw) and its speeds."""
    turn = 2.0 * np.pi * i / LAP
    q = np.array([0.3 * i, 0.2 * np.cos(turn), 0.5 * np.sin(turn)])
    return q, np.array([0.0, -np.sin(turn), np.cos(turn)])


def go(controller: Controller, plans: int, first: int = 0, start: float = 0.0) -> list[np.ndarray]:
    """Plan in the states of a lap; returns what was sent."""
    return [controller.step(State(*place(i), start + DT * (i - first))) for i in range(first, first + plans)]


def tried(controller: Controller, row: int = 0, e: int = 0) -> np.ndarray:
    """Knots [P, nu] of a recalled sample of the last plan."""
    return controller.plan_step.strategy.knots.numpy()[e, FIRST + row]


def test_what_was_sent_one_lap_ago_is_tried_again():
    controller = controller_with(joints=["base/y", "base/yaw"])
    sent = go(controller, LAP + 4)
    assert np.ptp(sent) > 0.1
    np.testing.assert_allclose(tried(controller), sent[3 : 3 + STEPS], atol=1e-6)


def test_nothing_is_tried_before_a_whole_horizon_is_known():
    controller = controller_with()
    sent = go(controller, STEPS)
    np.testing.assert_array_equal(tried(controller), 0.0)  # a null particle
    go(controller, 1, first=STEPS, start=DT * STEPS)
    np.testing.assert_allclose(tried(controller), sent, atol=1e-6)


def test_the_plan_goes_on_until_the_splice():
    controller = controller_with(splice=[0.0, 0.5], joints=["base/y", "base/yaw"])
    sent = go(controller, LAP + 3)
    plan = controller.plan_step.strategy.mean.numpy()[0].copy()
    sent += go(controller, 1, first=LAP + 3, start=DT * (LAP + 3))
    recalled = np.array(sent[3 : 3 + STEPS])
    np.testing.assert_allclose(tried(controller, 0), recalled, atol=1e-6)
    rest = np.vstack([plan[1:], plan[-1:]])  # moved on by one step
    np.testing.assert_allclose(tried(controller, 1), np.vstack([rest[:4], recalled[4:]]), atol=1e-6)


def test_several_moments_are_apart_and_the_nearest_comes_first():
    controller = controller_with(nearest=3, joints=["base/y", "base/yaw"], planner={"horizon": 24})
    sent = np.array(go(controller, 2 * LAP + 1, first=0))
    found = [
        [k for k in range(2 * LAP - 23) if np.allclose(tried(controller, row), sent[k : k + 24], atol=1e-6)]
        for row in range(3)
    ]
    moments = [k for (k,) in found]
    assert moments[0] == 0  # the same place, two laps ago; one lap ago the horizon has not passed
    assert min(abs(a - b) for i, a in enumerate(moments) for b in moments[:i]) >= 3  # a tenth of 24 steps


SLIDER = """
<mujoco>
  <worldbody>
    <body name="cart">
      <joint name="along" type="slide" axis="1 0 0"/>
      <joint name="up" type="slide" axis="0 0 1" range="-1 1" limited="true"/>
      <joint name="turn" type="hinge" axis="0 1 0"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="up" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""


def test_places_that_never_come_back_say_nothing_of_what_is_near(tmp_path):
    """Of a joint that slides without end and of a floating ball the speeds count, the places do not."""
    path = tmp_path / "slider.xml"
    path.write_text(SLIDER)
    robot = {"name": "cart", "asset": str(path)}
    ball = {"name": "ball", "shape": "sphere", "size": 0.1, "mass": 1.0, "position": (2.0, 0.0, 0.1)}
    scene = make_scene(
        robot=[robot],
        object=[ball],
        goal={"object": "ball", "position": (1.0, 0.5)},
        cost=[{"term": "distance", "between": ["ball", "goal"]}],
        success={"position": 0.1},
        planner={"samples": 8, "horizon": STEPS, "randomize": False, "ancillary": [{"recall": 10.0, "splice": 0.0}]},
        engine={"threads": 1},
    )
    controller = Controller(scene, compiled=compile_scene(scene))
    rng, sent = np.random.default_rng(0), []
    layout = controller.layout
    states = [(layout.joint_q + rng.normal(size=layout.nq), rng.normal(size=layout.nv)) for _ in range(STEPS + 6)]
    for i, (q, v) in enumerate(states):
        q[-4:] /= np.linalg.norm(q[-4:])
        sent.append(controller.step(State(q, v, DT * i)))
    q, v = states[3]
    away = np.zeros(layout.nq)
    away[[layout.joint("cart/along", key="q"), 3, 4, 5]] = 70.0, -40.0, 30.0, 5.0
    away[layout.joint("cart/turn", key="q")] = 2.0 * np.pi
    controller.step(State(q + away, v, DT * (STEPS + 6)))
    np.testing.assert_allclose(tried(controller), sent[3 : 3 + STEPS], atol=1e-6)


def test_what_is_older_than_the_memory_is_forgotten():
    controller = controller_with(recall=DT * 10, joints=["base/y", "base/yaw"])
    sent = go(controller, LAP + 1)
    match = [k for k in range(LAP - STEPS + 1) if np.allclose(tried(controller), sent[k : k + STEPS], atol=1e-6)]
    assert match
    assert match[0] >= LAP - 10  # not at zero, where it is nearest


@pytest.mark.parametrize("how", ["reset", "clock"])
def test_a_run_that_begins_anew_remembers_nothing(how):
    controller = controller_with()
    go(controller, LAP + 4)
    if how == "reset":
        controller.reset()
    go(controller, STEPS, start=0.0)
    np.testing.assert_array_equal(tried(controller), 0.0)


def test_every_environment_has_its_own_memory():
    controller = controller_with(envs=2, joints=["base/y", "base/yaw"])
    sent = []
    for i in range(LAP + 1):
        (q, v), (other_q, other_v) = place(i), place(i + 7)
        q, v = np.stack([q, other_q]), np.stack([v, other_v])
        sent.append(controller.step(State(q, v, DT * i)))
    sent = np.array(sent)
    for e in range(2):
        np.testing.assert_allclose(tried(controller, e=e), sent[:STEPS, e], atol=1e-6)
    assert np.abs(sent[:STEPS, 0] - sent[:STEPS, 1]).max() > 0.01


@pytest.mark.parametrize("envs", [1, 2])
def test_a_state_that_is_not_finite_is_left_out(envs):
    """What was sent before it is held until there is a state again, whatever other robots are observed."""
    controller, sent = controller_with(envs=envs, joints=["base/y", "base/yaw"]), []
    for i in range(LAP + 3):
        q, v = (np.tile(part, (envs, 1)) for part in place(i))
        if i == 3:
            q[0] = np.nan
        sent.append(controller.step(State(q, v, DT * i))[0])
    known = [sent[i] for i in (2, 2, 4, 5, 6, 7, 8, 9)]
    np.testing.assert_allclose(tried(controller), known, atol=1e-6)


def test_a_state_that_is_planned_for_twice_is_remembered_once():
    controller = controller_with(joints=["base/y", "base/yaw"])
    sent = go(controller, 3)
    sent[2:] = go(controller, LAP, first=2, start=DT * 2)
    controller.step(State(*place(LAP + 2), DT * (LAP + 2)))
    np.testing.assert_allclose(tried(controller), sent[2 : 2 + STEPS], atol=1e-6)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"joints": "base/w"}, r"ancillary\[0\]\.joints: no such joint; found 'base/w'"),
        ({"nearest": 30}, r"planner\.samples: the mean and 31 fixed samples \(.*ancillary\)"),
        ({"recall": 0.05}, r"ancillary\[0\]\.recall: is shorter than what a plan of .* needs.*; found 0\.05"),
        ({"splice": 1.0}, "splice"),
        ({"splice": []}, "splice"),
        ({"observation": "goal"}, "'observation' is a key of policy, not of recall"),
        ({"function": "mine"}, "needs one of function, motions, recall and policy; found function, recall"),
    ],
)
def test_tables_that_cannot_be_are_refused(table, message):
    with pytest.raises((SceneError, ValueError), match=message):
        controller_with(**table)
