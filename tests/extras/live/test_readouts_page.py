# SPDX-License-Identifier: Apache-2.0
"""What a browser reads out beside what the session has, and the sliders of norms."""

import re
import time

import numpy as np
import pytest
from needs import needs, reason
from swinging import write_swinging

pytest.importorskip("viser", reason=reason("viser"))
pytest.importorskip("playwright.sync_api", reason=reason("playwright"))

from live_page import WAIT, launched, opened, press, serving, show, until, without_note

from warpmpc.extras.live.readouts import model_facts
from warpmpc.extras.live.session import Session
from warpmpc.extras.live.snapshot import WINDOW

pytestmark = [pytest.mark.browser, needs("Chromium")]


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    session = Session(write_swinging(tmp_path_factory.mktemp("swinging")), device="cpu")
    with serving(session) as (_, url), launched() as browser:
        time.sleep(1.0)
        assert session.snapshot.steps == 0, "nobody has seen the start"
        page = opened(browser, url)
        without_note(page)
        yield session, page
        page.close()


@pytest.fixture
def session(served):
    session = served[0]
    session.pause(False)
    until(lambda: not session.snapshot.paused)
    return session


@pytest.fixture
def page(served):
    return served[1]


ROWS = """() => {
    const shown = [...document.querySelectorAll(".readout")].filter(table => table.offsetParent);
    return shown.flatMap(table => [...table.rows]).map(row => [...row.cells].map(
        cell => cell.querySelector("meter")?.value ?? cell.textContent));
}"""
"""Cells of the tables in the tab that is open."""


def rows(page):
    return page.evaluate(ROWS)


def plan_line(page):
    return page.get_by_text("plans/s").first.text_content(timeout=WAIT)


def number(pattern, text):
    """The number that a pattern finds in a text."""
    return float(re.search(pattern, text).group(1))


def test_joints_and_sensors_move_as_the_plants(page, session):
    show(page, "State")
    until(lambda: session.snapshot.steps > 20)
    session.pause()
    until(lambda: session.snapshot.paused)
    seen = session.snapshot
    wanted = [*seen.joint_q, *seen.sensor]
    until(lambda: len(rows(page)) == len(wanted))
    until(lambda: np.allclose([float(row[4]) for row in rows(page)], wanted, atol=6e-4))
    found = rows(page)
    assert [row[0] for row in found[:3]] == ["swing", "turn", "angle"]
    assert (found[0][1], found[0][3]) == ("-1.5", "2")
    np.testing.assert_allclose([row[2] for row in found], wanted, atol=1e-5)
    steps = seen.steps
    session.single_step()
    until(lambda: session.snapshot.steps > steps)
    until(lambda: float(rows(page)[1][4]) == pytest.approx(session.snapshot.joint_q[1], abs=6e-4))


def test_settings_are_those_of_both_models_and_follow_the_planner(page, session):
    show(page, "Model")
    until(lambda: rows(page) == [list(row) for row in model_facts(session.controller, session.plant)])
    session.set_key("planner.samples", "24")
    until(lambda: ["worlds", "24", "1"] in rows(page))
    assert session.controller.shape.worlds == 24


def test_rate_times_and_age_of_plans_are_read_out(page, session):
    session.pace, session.lock_step = 0.5, True  # plans are never late in lock step, however busy the machine is
    until(lambda: session.snapshot.lock_step)
    time.sleep(WINDOW)
    steps, start = session.snapshot.steps, time.monotonic()
    until(lambda: time.monotonic() > start + WINDOW and session.snapshot.steps > steps + 20)
    seen = session.snapshot
    controls = (seen.steps - steps) / (time.monotonic() - start)  # as many as a busy machine makes
    assert seen.rate.rate == pytest.approx(controls, rel=0.3), "one plan for every control"
    assert seen.rate.rate < 1.3 * 0.5 / session.scene.timing.control_dt
    session.lock_step = False
    until(lambda: number(r"([\d.]+) plans/s", plan_line(page)) == pytest.approx(session.snapshot.rate.rate, rel=0.1))
    switch = page.get_by_role("checkbox", name="plan", exact=True)
    press(switch, "Space", until=lambda: not session.planning)
    until(lambda: session.snapshot.rate.rate == 0.0)
    session.pause()
    until(lambda: session.snapshot.paused)
    seen = session.snapshot
    assert seen.age > 0.2
    until(lambda: number(r"age ([\d.]+) ms", plan_line(page)) == pytest.approx(1e3 * seen.age, abs=1.0))
    until(lambda: number(r"([\d.]+) plans/s", plan_line(page)) == 0.0)  # two snapshots of a control have one age
    line = plan_line(page)
    assert number(r"plan ([\d.]+) ms", line) == pytest.approx(seen.rate.p50, abs=0.06)
    assert number(r"p99 ([\d.]+) ms", line) == pytest.approx(seen.rate.p99, abs=0.06)
    press(switch, "Space", until=lambda: session.planning)
    session.pace = 1.0


def cost_of_lift(session):
    """Weighted cost of the term ahead, and the heights that it is of."""
    seen = session.snapshot.forecast
    bodies = session.controller.rollout().body_q
    return seen.cost[0], bodies[1:, session.controller.layout.body_name.index("arm/wheel"), 2].astype(float)


def test_a_norms_slider_changes_the_terms_cost_and_goes_back(page, session):
    session.pause()
    until(lambda: session.snapshot.paused)
    show(page, "Cost")
    slider = page.get_by_role("slider").nth(len(session.scene.cost))  # below the weights
    slider.wait_for(timeout=WAIT)
    p = 0.1
    for key, wanted in (("End", 0.4), ("Home", 0.001)):
        press(slider, key, until=lambda: session.snapshot.values["cost.lift.norm.p"] == wanted)  # noqa: B023
        steps = session.snapshot.steps
        session.single_step()
        until(lambda: session.snapshot.steps > steps)  # noqa: B023
        cost, height = cost_of_lift(session)
        np.testing.assert_allclose(cost, 5.0 * (np.sqrt(height**2 + wanted**2) - wanted), rtol=1e-3, atol=1e-5)
        assert not np.allclose(cost, 5.0 * (np.sqrt(height**2 + p**2) - p), rtol=1e-2)
    session.set_key("cost.lift.norm.p", "0.1")
    until(lambda: float(slider.get_attribute("aria-valuenow")) == pytest.approx(0.1))
    assert not session.snapshot.message


def test_a_norm_that_cannot_be_is_told_and_put_back(page, session):
    session.set_key("cost.still.norm.p", "0.5")
    page.get_by_text("refused").wait_for(timeout=WAIT)
    assert session.snapshot.values["cost.still.norm.p"] == 1.5


EDGES = """() => [...document.querySelectorAll(".uplot canvas")].filter(canvas => canvas.offsetParent).map(canvas => {
    const drawn = (w, h) => canvas.getContext("2d").getImageData(0, 0, w, h).data.filter(byte => byte).length;
    return [drawn(canvas.width, canvas.height), drawn(1, canvas.height) + drawn(canvas.width, 1)];
})"""
"""Bytes that are not zero of every plot, and of its left and upper edge."""


def test_numbers_of_axes_are_whole(session, page):
    show(page, "Curves")
    weights = {name: float(session.controller.task[name]) for name in session.controller.task.weight_name}
    for name in weights:
        session.set_value(name, 1e-5)  # numbers of seven digits
    steps = session.snapshot.steps
    session.reset()
    until(lambda: 5 < session.snapshot.steps != steps)
    time.sleep(1.0)
    edges = page.evaluate(EDGES)
    for name, value in weights.items():
        session.set_value(name, value)
    assert len(edges) >= 4
    assert all(drawn for drawn, _ in edges)
    assert not any(edge for _, edge in edges)
