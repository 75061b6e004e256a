# SPDX-License-Identifier: Apache-2.0
import time

import numpy as np
import pytest

from warpmpc.live.session import Session
from warpmpc.model.safe import safe_command

FAST = ["engine.threads=1", "planner.samples=16", "planner.horizon=20"]


def until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.01)


@pytest.fixture
def session():
    session = Session("cylinder_push", overrides=FAST, engine="fused", device="cpu", pace=4.0)
    session.start()
    yield session
    session.stop()
    session.join(20.0)
    assert not session.is_alive()


def test_the_robot_moves_and_what_there_is_to_see_is_published(session):
    start = session.snapshot.body_q
    until(lambda: session.snapshot.steps >= 3 and session.snapshot.ways is not None)
    seen = session.snapshot
    assert not np.allclose(seen.body_q, start)
    assert seen.ways.best.shape[-1] == 3
    assert set(seen.terms) == {*session.controller.costs.labels, "total"}


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


def test_a_weight_is_changed_and_outlives_a_reset(session):
    session.set_value("reach", 2.0)
    session.reset()
    until(lambda: session.snapshot.episode == 2)
    assert session.controller.task["reach"] == 2.0


def test_a_new_planner_plans_and_a_wrong_one_is_refused(session):
    session.set_key("planner.samples", "24")
    until(lambda: session.controller.shape.samples == 24)
    session.set_key("planner.horizon", "-1")
    until(lambda: "horizon" in session.snapshot.message)
    assert session.controller.shape.horizon == 20
    assert session.keys == {"planner.samples": "24"}


def test_without_planning_the_drives_get_their_safe_command(session):
    session.plan_or_not(False)
    until(lambda: not session.planning and session.snapshot.ways is None)
    session.pause()
    until(lambda: session.snapshot.paused)
    layout, state, dt = session.plant.layout, session.plant.state, session.scene.timing.control_dt
    control = session.snapshot.control.copy()
    assert control.any(), "it holds where it is"
    wanted = safe_command(layout, state.joint_q[None], state.joint_qd[None], dt)[0]
    np.testing.assert_allclose(control, np.clip(wanted, layout.control_lower, layout.control_upper), atol=0.02)
