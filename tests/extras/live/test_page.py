# SPDX-License-Identifier: Apache-2.0
"""The page in a real browser, clicked and dragged with the mouse."""

import threading
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from needs import needs, reason
from rerun.chunk import RrdReader
from typer.testing import CliRunner

viser = pytest.importorskip("viser", reason=reason("viser"))
pytest.importorskip("playwright.sync_api", reason=reason("playwright"))

from live_page import WAIT, choose, click_until, launched, opened, press, serving, show, until, without_note  # noqa: E402
from post_scene import POST  # noqa: E402

from warpmpc import load_scene  # noqa: E402
from warpmpc.cli.main import app  # noqa: E402
from warpmpc.extras.live.readouts import FORESIGHT  # noqa: E402
from warpmpc.extras.live.session import Session  # noqa: E402
from warpmpc.extras.record.shapes import scene_bounds  # noqa: E402

FAST = ["engine.name=fused", "planner.refine=false", "engine.threads=1", "planner.samples=32", "planner.horizon=30"]
pytestmark = [
    pytest.mark.browser,
    pytest.mark.filterwarnings("error::DeprecationWarning"),
    needs("Chromium"),
]


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A session, its viser server and its URL; the working directory is a new one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("live"))
        session = Session("cylinder_push", overrides=FAST, device="cpu")
        with serving(session) as (server, url):
            yield session, server, url


@pytest.fixture(scope="module")
def browser():
    with launched() as browser:
        yield browser


@pytest.fixture(scope="module")
def page(served, browser):
    page = opened(browser, served[2])
    without_note(page)
    yield page
    page.close()


@pytest.fixture
def session(served, page):
    """The session at the start of an episode, shown and not paused."""
    session = served[0]
    session.pause(False)
    session.set_value("goal", (1.0, 1.5, 0.0, 0.0, 0.0, 0.0, 1.0))
    episode = session.snapshot.episode
    session.reset()
    until(lambda: session.snapshot.episode > episode and not session.snapshot.paused)
    return session


def pixel(served, page, point):
    """Where a point of the world ``[3]`` is on the page."""
    camera = next(iter(served[1].get_clients().values())).camera
    box = page.locator("canvas").first.bounding_box()
    forward = camera.look_at - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    away = point - camera.position
    scale = 0.5 * box["height"] / np.tan(0.5 * camera.fov) / (away @ forward)
    x = box["x"] + 0.5 * box["width"] + scale * (away @ right)
    return x, box["y"] + 0.5 * box["height"] - scale * (away @ np.cross(right, forward))


def drag(served, page, start, end):
    """Press the mouse at a point of the world ``[3]`` and move it to another."""
    page.mouse.move(*pixel(served, page, start))
    time.sleep(0.5)  # until it is seen that the mouse is there
    page.mouse.down()
    for share in (0.3, 0.6, 1.0):
        page.mouse.move(*pixel(served, page, start + share * (end - start)))


def drag_until(served, page, start, end, moved):
    """Drag from where something is, ``start()`` ``[3]``, until it moved, again where the page took no notice of it.

    The mouse button is down afterwards.
    """
    tries = 5
    while not moved():
        assert tries, "the page takes no drag"
        tries -= 1
        page.mouse.up()
        drag(served, page, start(), end)
        pause = time.monotonic() + 8.0
        while not moved() and time.monotonic() < pause:
            time.sleep(0.02)


def cart(session):
    return session.snapshot.body_q[session.plant.layout.body_name.index("discs/cart"), :3]


def off_goal(session):
    return float(np.linalg.norm(cart(session) - session.snapshot.poses["goal"][:3]))


def test_pause_step_and_reset(page, session):
    until(lambda: session.snapshot.steps > 3)
    click_until(page, "Pause", lambda: session.snapshot.paused)
    steps, episode = session.snapshot.steps, session.snapshot.episode
    clicks = click_until(page, "Step", lambda: session.snapshot.steps > steps)
    assert session.snapshot.steps <= steps + clicks
    click_until(page, "Reset", lambda: session.snapshot.episode > episode)
    until(lambda: session.snapshot.steps == 0)
    click_until(page, "Resume", lambda: session.snapshot.steps > 3)


def test_a_goal_that_is_dragged_is_followed_by_the_object(served, page, session):
    session.pause()  # before the object is there: it would lie in front of the arrow, and be what the mouse takes
    assert off_goal(session) > 0.4
    goal = session.snapshot.poses["goal"][:3]
    size = 0.3 * 1.15  # of the gizmo's arrows
    tip = np.array([size, 0.0, 0.0])
    way = (-0.6, 0.0, 0.0)
    drag_until(
        served,
        page,
        lambda: session.snapshot.poses["goal"][:3] + tip,
        goal + tip + way,
        lambda: abs(session.snapshot.poses["goal"][0] - goal[0] + 0.6) < 0.15,
    )
    page.mouse.up()
    assert off_goal(session) > 0.4
    session.pause(False)
    until(lambda: off_goal(session) < 0.15)


def test_an_object_that_is_dragged_away_is_brought_back(served, page, session):
    until(lambda: off_goal(session) < 0.1)
    rim = np.array([-0.12, -0.12, 0.1])  # over the middle are the goal's arrows
    end = cart(session) + rim + (-0.8, 0.55, 0.0)  # across the view: the mouse knows no depth
    drag_until(served, page, lambda: cart(session) + rim, end, lambda: off_goal(session) > 0.3)
    assert session.snapshot.pull is not None
    page.mouse.up()
    until(lambda: session.snapshot.pull is None)
    until(lambda: off_goal(session) < 0.15)


def test_a_slider_changes_the_cost_and_is_saved(page, session):
    show(page, "Cost")
    press(page.get_by_role("slider").nth(1), "ArrowRight", until=lambda: session.controller.task["reach"] > 0.5)
    show(page, "Scene")
    saved = Path.cwd() / "cylinder_push_tuned.toml"
    click_until(page, "Save", saved.exists)
    page.get_by_text("saved to").wait_for(timeout=WAIT)
    scene = load_scene(saved)
    assert scene.cost[1].weight == pytest.approx(session.controller.task["reach"])
    assert scene.planner.samples == 32, "of --set"
    result = CliRunner().invoke(app, ["check", str(saved), "--engine", "fused", "--device", "cpu"])
    assert result.exit_code == 0, result.output


def test_another_strategy_plans(page, session):
    show(page, "Planner")
    choose(page, "method", "cem", lambda: session.controller.scene.planner.method.value == "cem")
    until(lambda: session.snapshot.steps > 3)
    assert not session.snapshot.message


def test_a_recording_is_started_and_stopped(page, session):
    show(page, "Run")
    click_until(page, "Record", lambda: session.snapshot.recording)
    file, steps = Path(session.snapshot.recording), session.snapshot.steps
    page.get_by_text(file.name).wait_for(timeout=WAIT)
    until(lambda: session.snapshot.steps > steps + 3)
    click_until(page, "Stop recording", lambda: not session.snapshot.recording)
    recorded = {chunk.entity_path for chunk in RrdReader(file).stream().to_chunks()}
    assert {"/cost/total", "/rollouts/best", "/scene/discs/cart"} <= recorded
    page.get_by_role("button", name="Record", exact=True).wait_for(timeout=WAIT)


def plans_a_control(page):
    """Plans for each of the last controls, as the page reads them out."""
    line = page.get_by_text("plans a control").first.text_content(timeout=WAIT)
    return float(line.split(" plans a control")[0].split(" ")[-1])


def test_a_slower_clock_buys_plans_which_lock_step_does_not(page, session):
    session.set_key("agent.plans", '"fit"')
    show(page, "Run")
    until(lambda: session.scene.agent.plans == "fit" and session.snapshot.steps > 20)
    choose(page, "speed", "400 %", lambda: session.pace == 4.0)
    steps = session.snapshot.steps
    until(lambda: session.snapshot.steps > steps + 40)
    fast = session.snapshot.plans
    choose(page, "speed", "10 %", lambda: session.pace == 0.1)
    until(lambda: session.snapshot.plans > 3.0 * fast and session.snapshot.plans > 5.0)
    until(lambda: plans_a_control(page) > 3.0 * fast)
    press(page.get_by_role("checkbox", name="lock step"), "Space", until=lambda: session.lock_step)
    choose(page, "speed", "400 %", lambda: session.pace == 4.0)
    until(lambda: session.snapshot.lock_step and session.snapshot.plans == 1.0)
    session.step_or_follow(False)
    session.set_key("agent.plans", '"one"')
    session.pace = 1.0
    until(lambda: session.scene.agent.plans == "one" and not session.snapshot.lock_step)


def test_tabs_come_and_go(served, page, browser, session):
    session.pause()  # what moves is drawn without a GPU, and a page that loads has to wait for it
    until(lambda: session.snapshot.paused)
    second = opened(browser, served[2])
    click_until(second, "Resume", lambda: not session.snapshot.paused)
    click_until(second, "Pause", lambda: session.snapshot.paused)
    show(page, "Run")
    page.get_by_role("button", name="Resume").wait_for(timeout=WAIT)
    click_until(page, "Resume", lambda: not session.snapshot.paused)
    second.close()
    steps = session.snapshot.steps
    until(lambda: session.snapshot.steps > steps + 3)


CURVES_HEIGHT = """title => {
    const plot = [...document.querySelectorAll(".uplot")].find(p => p.textContent.includes(title));
    const canvas = plot.querySelector("canvas");
    const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    const rows = [];
    for (let i = 0; i < data.length; i += 4)
        if (data[i + 3] > 0 && Math.max(...data.slice(i, i + 3)) - Math.min(...data.slice(i, i + 3)) > 60)
            rows.push(Math.floor(i / 4 / canvas.width));
    return rows.length ? rows.at(-1) - rows[0] : 0;
}"""
"""Height of the curves of a plot [pixels], few if they are flat: what is coloured, for axes and texts are grey."""


def foreseen_so_far(page):
    """Error of what was foreseen, as the page reads it out [%]."""
    line = page.get_by_text("% off").first.text_content(timeout=WAIT)
    return float(line.split("foresight ")[1].split("%")[0])


def test_what_was_foreseen_is_drawn_beside_what_came_and_a_wrong_model_raises_the_number(page, session):
    show(page, "Run")
    until(lambda: session.snapshot.foreseen is not None and session.snapshot.time > 1.0)
    assert foreseen_so_far(page) < 2.0
    until(lambda: page.evaluate(CURVES_HEIGHT, FORESIGHT) > 20)
    for key, wrong, right in [("plant.factor", "{ discs = { mass = 3.0 } }", "{}"), ("plant.delay", "0.06", "0.0")]:
        episode = session.snapshot.episode
        session.set_key(key, wrong)
        until(lambda: session.snapshot.episode > episode and session.snapshot.foreseen is not None)  # noqa: B023
        until(lambda: session.snapshot.foreseen.error > 0.1)
        until(lambda: foreseen_so_far(page) > 10.0)
        session.set_key(key, right)
    until(lambda: session.snapshot.foreseen is not None and session.snapshot.foreseen.error < 0.02)
    assert not session.snapshot.message


@pytest.fixture
def elsewhere(tmp_path):
    """URL of an empty page of another server of this machine."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=tmp_path)) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_another_page_of_the_same_browser_cannot_connect(served, browser, elsewhere):
    join = """([url, version]) => new Promise(done => {
        const socket = new WebSocket(url, [`viser-v${version}`]);
        socket.onmessage = () => done("joined");
        socket.onclose = () => done("refused");
    })"""
    url = served[2].replace("http", "ws", 1)
    with browser.new_context() as context:
        own, other = context.new_page(), context.new_page()
        own.goto(served[2], wait_until="commit")  # the cookie is of both: it knows no port
        other.goto(elsewhere)
        assert own.evaluate(join, [url.partition("?")[0], viser.__version__]) == "joined"
        assert other.evaluate(join, [url, viser.__version__]) == "refused"


def open_costs(page, session):
    """Open the tab of the costs once the page is that of the session's scene, and wait for all weights."""
    scene = session.scene
    page.get_by_text(scene.title or scene.name, exact=True).first.wait_for(timeout=WAIT)
    show(page, "Cost")
    page.get_by_role("slider").nth(len(scene.cost_labels) - 1).wait_for(timeout=WAIT)


def test_another_scene_is_chosen(page, session):
    show(page, "Scene")
    page.get_by_role("combobox", name="scene", exact=True).fill("pendulum", timeout=WAIT)
    # of a few: the list of all scenes is longer than this window
    click_until(page, "pendulum", lambda: session.snapshot.source == "pendulum", "option")
    until(lambda: session.snapshot.steps > 3)
    assert session.scene.name == "pendulum"
    assert not session.snapshot.message
    open_costs(page, session)
    assert not page.get_by_text("reach", exact=True).count()  # of the other scene


@pytest.fixture(scope="module")
def post(served, page):
    """A session of a robot beside a post, shown, and a place on the arrows to move the post by."""
    session = served[0]
    Path("post.toml").write_text(POST)
    session.pause()
    session.switch("post.toml")
    until(lambda: session.snapshot.source == "post.toml")
    seen = session.snapshot
    open_costs(page, session)
    session.pace, session.lock_step = 4.0, True  # plans are not late at four times real time
    session.pause(False)
    return session, 0.85 * 0.3 * scene_bounds(session.plant.layout, seen.body_q, seen.poses["goal"])[1]


def place(session):
    return session.snapshot.body_q[-1, :2]


def test_a_post_is_touched_once_the_slider_says_that_it_costs_nothing(page, post):
    session, _ = post
    until(lambda: session.snapshot.time > 4.0)
    assert session.plant.contact.max_force < 1.0
    slider = page.get_by_role("slider").nth(1)
    press(slider, "Home", until=lambda: session.controller.task["contact_force"] == 0.0)
    until(lambda: session.plant.contact.max_force > 100.0)  # it presses on towards the goal


def test_a_post_that_is_dragged_away_lets_the_robot_through(served, page, post):
    session, arrow = post
    session.set_value("goal", (-1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0))  # no arrows where those of the post are
    until(lambda: np.linalg.norm(place(session) - (-1.0, -1.0)) < 0.1)
    session.set_value("contact_force", 10.0)
    until(lambda: session.controller.task["contact_force"] == 10.0)
    start = session.snapshot.poses["post"][:3]
    tip = np.array([arrow, 0.0, 0.0])
    drag_until(
        served,
        page,
        lambda: session.snapshot.poses["post"][:3] + tip,
        start + tip + (1.0, 0.0, 0.0),
        lambda: session.snapshot.poses["post"][0] > start[0] + 0.8,
    )
    page.mouse.up()
    np.testing.assert_allclose(session.snapshot.poses["post"][1:3], start[1:], atol=0.02)
    session.reset()
    session.set_value("goal", (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    until(lambda: np.linalg.norm(place(session) - (1.0, 0.0)) < 0.1)
    assert session.plant.contact.max_force < 1.0
    np.testing.assert_allclose(session.plant.pose("post"), session.snapshot.poses["post"], atol=1e-6)
