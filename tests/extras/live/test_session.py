# SPDX-License-Identifier: Apache-2.0
import time
from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from warpmpc.extras.live.session import Session
from warpmpc.scene.model.control_values import safe_command

FAST = ["engine.threads=1", "planner.refine=false", "planner.samples=16", "planner.horizon=20"]


def until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.01)


def started(source="cylinder_push", *, overrides=FAST, **keys):
    session = Session(source, overrides=overrides, device="cpu", pace=4.0, **keys)
    session.start()
    return session


def ended(session):
    session.stop()
    session.join(20.0)
    assert not session.is_alive()


@pytest.fixture
def session():
    session = started()
    yield session
    ended(session)


def steps_on(session, count=3):
    steps = session.snapshot.steps
    until(lambda: session.snapshot.steps >= steps + count)


def test_the_robot_moves_and_what_there_is_to_see_is_published(session):
    start = session.snapshot.body_q
    until(lambda: session.snapshot.steps >= 3 and session.snapshot.paths is not None)
    seen = session.snapshot
    assert not np.allclose(seen.body_q, start)
    assert seen.paths.best.shape[-1] == 3
    assert np.isfinite([seen.cost, seen.eta, seen.beta, seen.plan_ms]).all()


@pytest.mark.parametrize("pace", [0.0, -1.0, float("nan"), float("inf"), 1e-300])
def test_a_pace_that_is_none_is_refused(session, pace):
    with pytest.raises(ValueError, match="pace"):
        session.pace = pace
    assert session.pace == 4.0
    steps_on(session)


@pytest.mark.parametrize("source", ["cylinder_push", "point_reach"])
def test_what_is_ahead_costs_what_the_plan_says(source):
    session = Session(source, overrides=FAST[:3], device="cpu")
    controller, plant = session.controller, session.plant
    for _ in range(2):
        plant.apply(controller.step(plant.observe()))
    session._rollouts.update()
    ahead = session._rollouts.forecast
    summed = ahead.cost @ controller.plan_step.grid.discount
    np.testing.assert_allclose(summed, list(controller.info.terms.values()), rtol=1e-3, atol=1e-4)
    assert ahead.times[0] == controller.info.time
    assert ahead.control.shape == (controller.shape.horizon, plant.layout.nu)


def test_a_plan_that_fell_back_has_no_rollouts_to_look_at():
    session = Session("cylinder_push", overrides=FAST, device="cpu")
    seen, rollouts = session.plant.observe(), session._rollouts
    session.controller.step(seen)
    rollouts.update()
    assert rollouts.paths.others.shape[0] == len(rollouts.paths.colors) == 16
    session.controller.step(replace(seen, joint_q=seen.joint_q * np.nan))
    rollouts.update()  # costs of the plan before are still there
    assert (rollouts.paths, rollouts.forecast) == (None, None)


def test_pause_holds_and_a_single_step_is_one_step(session):
    session.pause()
    until(lambda: session.snapshot.paused)
    steps = session.snapshot.steps
    time.sleep(0.2)
    assert session.snapshot.steps == steps
    session.single_step()
    until(lambda: session.snapshot.steps == steps + 1)
    time.sleep(0.2)
    assert session.snapshot.steps == steps + 1


def test_the_slowest_pace_listens(session):
    steps_on(session)
    session.pace = 1e-5  # a control takes half an hour
    time.sleep(0.1)
    steps = session.snapshot.steps
    session.set_value("reach", 2.0)
    until(lambda: session.snapshot.values["reach"] == 2.0, seconds=1.0)
    session.single_step()
    until(lambda: session.snapshot.steps == steps + 1, seconds=2.0)
    session.pace = 4.0
    steps_on(session)


def test_a_weight_is_changed_and_outlives_a_reset(session):
    session.set_value("reach", 2.0)
    session.reset()
    until(lambda: session.snapshot.episode == 2)
    assert session.controller.task["reach"] == 2.0


def test_a_new_planner_plans_and_a_wrong_one_is_refused(session):
    steps_on(session)
    session.set_key("planner.samples", "24")
    until(lambda: session.controller.shape.samples == 24)
    assert session.snapshot.episode == 1, "the episode goes on"
    session.set_key("planner.horizon", "-1")
    until(lambda: "horizon" in session.snapshot.message)
    assert session.controller.shape.horizon == 20
    assert session.keys == {"planner.samples": "24"}
    steps_on(session)


def test_another_engine_plans_in_a_new_episode_and_one_that_cannot_is_refused():
    session = started(engine="fused")
    try:
        session.set_key("engine.name", '"mujoco"')
        session.set_key("engine.substeps", "4")
        until(lambda: session.snapshot.build == 2)
        assert session.controller.engine.name == "mujoco"
        assert session.scene.engine.substeps == 4
        session.set_key("engine.name", '"kinematic"')
        until(lambda: "kinematic" in session.snapshot.message)
        assert session.controller.engine.name == "mujoco"
        steps_on(session)
    finally:
        ended(session)


def test_letters_typed_one_by_one_are_one_change(session):
    for text in ("2", "24", "240"):
        session.set_key("planner.samples", text)
        time.sleep(0.05)
        assert session.controller.shape.samples == 16
    until(lambda: session.controller.shape.samples == 240)
    assert not session.snapshot.message


@pytest.mark.parametrize("wrong", [ZeroDivisionError("a slip"), OSError("a slip"), KeyError("a slip")])
def test_any_error_of_a_change_is_told_and_ends_nothing(session, wrong):
    def slip():
        raise wrong

    session.do(slip)
    until(lambda: "a slip" in session.snapshot.message)
    steps_on(session)
    session.set_value("reach", 1.0)
    until(lambda: not session.snapshot.message)


def test_an_error_of_a_plan_pauses_and_is_told(session, monkeypatch):
    def slip(_):
        raise RuntimeError("a slip of the plan")

    with monkeypatch.context() as patch:
        patch.setattr(session.controller, "plan", slip)
        until(lambda: session.snapshot.message == "a slip of the plan")
        assert session.snapshot.paused
    session.pause(False)
    steps_on(session)


def test_without_planning_the_last_plan_is_followed_and_then_the_robot_holds(session):
    steps_on(session)
    session.plan_or_not(False)
    until(lambda: not session.snapshot.planning and session.snapshot.paths is None)
    plan, dt = session._plan, session.scene.timing.control_dt
    seen = session.snapshot
    assert seen.time <= plan.times[-1]
    np.testing.assert_allclose(seen.control, plan.at(seen.time - dt), atol=1e-6)
    until(lambda: session.snapshot.status == "the plan has ended")
    steps_on(session, 40)
    session.pause()
    until(lambda: session.snapshot.paused)
    layout, state = session.plant.layout, session.plant.state
    wanted = safe_command(layout, state.joint_q[None], state.joint_qd[None], dt)[0]
    held = np.clip(wanted, layout.control_lower, layout.control_upper)
    np.testing.assert_allclose(session.snapshot.control, held, atol=0.02)


def test_without_control_the_drives_get_their_safe_command_and_plans_go_on(session):
    steps_on(session)
    session.control_or_not(False)
    until(lambda: not session.snapshot.controlling)
    steps_on(session, 40)
    place = session.snapshot.body_q
    steps_on(session, 10)
    np.testing.assert_allclose(session.snapshot.body_q, place, atol=0.01)
    assert session.snapshot.paths is not None
    assert session.controller.info.time > session.snapshot.time - 0.1
    session.control_or_not(True)
    until(lambda: not np.allclose(session.snapshot.body_q, place, atol=0.05))


def test_another_scene_and_one_that_is_not_there(session):
    session.set_value("reach", 2.0)
    session.switch("pendulum")
    until(lambda: session.snapshot.source == "pendulum" and session.snapshot.steps > 2)
    assert not session.tuned
    session.switch("pendulums")
    until(lambda: "no such scene" in session.snapshot.message)
    assert session.snapshot.source == "pendulum"
    steps_on(session)


def test_the_plants_own_properties_are_switched_off():
    session = started("omni_push_box")
    try:
        assert session.plant.properties is not None
        session.set_key("plant.randomize", "false")
        until(lambda: session.plant.properties is None)
        until(lambda: session.snapshot.build == 2)
        steps_on(session)
    finally:
        ended(session)


def test_an_object_dragged_away_is_brought_back():
    session = started(overrides=["engine.threads=1", "planner.samples=32"])
    try:
        cart = session.plant.layout.body_name.index("discs/cart")

        def distance():
            return np.linalg.norm(session.snapshot.body_q[cart, :2] - session.snapshot.poses["goal"][:2])

        until(lambda: distance() < 0.1, seconds=60.0)
        place = session.snapshot.body_q[cart, :3]
        session.grab("discs/cart", place)
        session.pull(place + (-0.6, -0.4, 0.0))
        until(lambda: distance() > 0.4)
        assert session.snapshot.pull is not None
        session.release()
        until(lambda: session.snapshot.pull is None)
        until(lambda: distance() < 0.1, seconds=60.0)
    finally:
        ended(session)


def test_posts_are_hit_once_touching_them_costs_nothing():
    session = started("holonomic_2d", overrides=["engine.threads=1", "planner.samples=64"])
    try:
        until(lambda: session.snapshot.body_q[-1, 0] > 1.5, seconds=60.0)
        assert session.plant.contact.max_force == 0.0
        session.set_value("world_collision", 0.0)
        session.reset()
        until(lambda: session.snapshot.episode == 2 and session.plant.contact.max_force > 10.0, seconds=60.0)
    finally:
        ended(session)


def test_what_is_recorded_opens_and_a_reset_ends_it(session, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    steps_on(session)
    session.record()
    until(lambda: session.snapshot.recording)
    first = session.snapshot.recording
    steps_on(session, 10)
    session.reset()
    until(lambda: session.snapshot.episode == 2 and not session.snapshot.recording)
    session.record()
    until(lambda: session.snapshot.recording)
    assert session.snapshot.recording != first
    steps_on(session)
    session.record(False)
    until(lambda: not session.snapshot.recording)
    for file in tmp_path.iterdir():
        recorded = {chunk.entity_path for chunk in RrdReader(file).stream().to_chunks()}
        assert {"/cost/total", "/rollouts/best", "/scene/discs/cart"} <= recorded
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("plans", ["one", "fit"])
def test_a_plant_that_is_slowed_down_waits_for_no_plan(plans):
    session = started(overrides=[*FAST, f'agent.plans="{plans}"'])
    session.pace = 0.4
    steps_on(session, 25)
    made, dt = session.snapshot.plans, session.scene.timing.control_dt
    assert (made > 2.0) if plans == "fit" else (0.4 < made < 1.6)
    slow = session.controller.plan
    session.do(lambda: setattr(session.controller, "plan", lambda state: (time.sleep(0.25), slow(state))[1]))
    session.pace = 1.0
    steps_on(session)
    begin, start = session.snapshot.time, time.monotonic()
    steps_on(session, round(1.0 / dt))
    passed = session.snapshot.time - begin
    assert passed / (time.monotonic() - start) > 0.7, "the plant goes on while a plan takes a quarter of a second"
    assert session.snapshot.plans < 0.5 * (0.25 / dt)
    session.do(lambda: setattr(session.controller, "plan", slow))
    session.step_or_follow(True)
    until(lambda: session.snapshot.lock_step and session.snapshot.plans > 0.9)
    steps_on(session, 22)
    assert session.snapshot.plans == 1.0
    ended(session)
