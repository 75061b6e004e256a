# SPDX-License-Identifier: Apache-2.0
"""A session's page in a real browser.

Playwright's checks before a click wait for frames, of which a browser that draws without a GPU has few: ``force``
leaves them out, the mouse is as real.
"""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager, suppress

import pytest
import viser
from needs import CHROMIUM
from playwright.sync_api import TimeoutError, sync_playwright
from shared.ports import free_port

from warpmpc.extras.live.page import Access, serve

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WAIT = 60e3
"""Longest wait for a part of the page [ms]; it is drawn without a GPU."""


def until(condition, seconds=150.0):
    """Wait for a condition, long: beside three busy suites 4 s of an episode took more than 40 s."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.02)


@contextmanager
def serving(session):
    """Serve a session; yields its viser server and its URL."""
    port = free_port()
    servers = []
    with pytest.MonkeyPatch.context() as patch:
        make = viser.ViserServer
        patch.setattr(viser, "ViserServer", lambda **keys: servers.append(make(**keys)) or servers[0])
        ending = threading.Event()
        access = Access("127.0.0.1", port)
        thread = threading.Thread(target=serve, args=(session, access), kwargs={"ending": ending})
        thread.start()
        until(lambda: session.is_alive() and servers)
        yield servers[0], access.url
        ending.set()
        thread.join(30.0)
    assert not thread.is_alive()


@contextmanager
def launched():
    """A browser without a window."""
    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield browser
        browser.close()


def opened(browser, url, *, width=900, height=420, scale=0.5):
    """A tab of a browser with the page in it."""
    page = browser.new_page(viewport={"width": width, "height": height}, device_scale_factor=scale)
    page.goto(url)
    page.get_by_role("button", name="Reset").wait_for(timeout=WAIT)
    return page


def without_note(page):
    """Close the note that there is no GPU."""
    page.locator(".mantine-Notification-closeButton").first.click(force=True, timeout=WAIT)


def click_until(page, name, condition, role="button"):
    """Click at a button, a tab or another part of the page by its name, again where nothing came of it.

    A part that is drawn anew just then takes no click.

    Returns:
        Number of clicks.
    """
    end = time.monotonic() + 40.0
    clicks = 0
    while not condition():
        assert time.monotonic() < end, f"a click at {name} does nothing"
        clicks += 1
        with suppress(TimeoutError):  # what it did may have renamed the button
            page.get_by_role(role, name=name, exact=True).click(force=True, timeout=2e3)
        pause = time.monotonic() + 3.0
        while not condition() and time.monotonic() < pause:
            time.sleep(0.02)
    return clicks


def show(page, name):
    """Open a tab of the page by its name."""
    tab = page.get_by_role("tab", name=name, exact=True)
    click_until(page, name, lambda: tab.get_attribute("aria-selected", timeout=WAIT) == "true", "tab")


def press(part, key, *, until):
    """Press a key on a slider, a switch or a list, again where the page did not take it: it may be drawn anew."""
    end = time.monotonic() + 40.0
    while not until():
        assert time.monotonic() < end, "the page does not take it"
        part.press(key, timeout=WAIT)
        pause = time.monotonic() + 1.0
        while not until() and time.monotonic() < pause:
            time.sleep(0.02)


def choose(page, name, option, condition):
    """Take an option of a list by their names, until a condition is true.

    The list is opened again in each try: a part that is drawn anew just then closes it.
    """
    box = page.get_by_role("combobox", name=name, exact=True)
    shown = page.get_by_role("option", name=option, exact=True)
    end = time.monotonic() + 40.0
    while not condition():
        assert time.monotonic() < end, f"no choice of {option}"
        with suppress(TimeoutError):
            if not shown.is_visible():
                box.press("ArrowDown", timeout=2e3)
                shown.wait_for(timeout=2e3)
            shown.click(force=True, timeout=2e3)
        pause = time.monotonic() + 3.0
        while not condition() and time.monotonic() < pause:
            time.sleep(0.02)
