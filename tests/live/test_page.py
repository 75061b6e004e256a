# SPDX-License-Identifier: Apache-2.0
import socket
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="needs viser")
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")

from warpmpc.live.page import require_port, serve  # noqa: E402
from warpmpc.live.session import Session  # noqa: E402

CHROMIUM = Path("/usr/bin/chromium")
FAST = ["engine.threads=1", "planner.samples=16", "planner.horizon=20"]
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WAIT = 60e3
"""Longest wait for a part of the page [ms]; it is drawn without a GPU."""

pytestmark = [pytest.mark.browser, pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Chromium")]


def until(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def served():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    session = Session("cylinder_push", overrides=FAST, engine="fused", device="cpu", pace=0.1)
    ending = threading.Event()
    where = {"host": "127.0.0.1", "port": port, "ending": ending}
    server = threading.Thread(target=serve, args=(session,), kwargs=where)
    server.start()
    until(session.is_alive)
    yield session, port
    ending.set()
    server.join(30.0)
    assert not server.is_alive()


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield browser
        browser.close()


def opened(browser, port):
    page = browser.new_page(viewport={"width": 900, "height": 600})
    page.goto(f"http://127.0.0.1:{port}")
    page.get_by_role("button", name="Reset").wait_for(timeout=WAIT)
    return page


def click(page, name):
    page.get_by_role("button", name=name, exact=True).dispatch_event("click", timeout=WAIT)


def test_the_page_steers_the_session_and_tabs_come_and_go(served, browser):
    session, port = served
    page = opened(browser, port)
    steps = session.snapshot.steps
    until(lambda: session.snapshot.steps > steps)

    click(page, "Pause")
    until(lambda: session.snapshot.paused)
    steps = session.snapshot.steps
    click(page, "Step")
    until(lambda: session.snapshot.steps == steps + 1)

    weight = session.controller.task["place"]
    slider = page.get_by_role("slider").nth(1)  # the first is the pace
    slider.focus(timeout=WAIT)
    slider.press("ArrowRight")
    until(lambda: session.controller.task["place"] > weight)

    click(page, "Reset")
    until(lambda: session.snapshot.episode == 2 and session.snapshot.steps == 0)

    second = opened(browser, port)
    click(second, "Resume")
    until(lambda: session.snapshot.steps > 0)
    page.close()
    second.close()
    steps = session.snapshot.steps
    until(lambda: session.snapshot.steps > steps)


def test_a_taken_port_is_refused():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(OSError, match="choose another with --port"):
            require_port("127.0.0.1", taken.getsockname()[1])
