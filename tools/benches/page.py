# SPDX-License-Identifier: Apache-2.0
"""What a page costs: plans per second without and with somebody who looks, and the updates that arrive there.

    python tools/bench.py page                    # omni_push_box
    python tools/bench.py page cylinder_push --steps 500 --chromium /usr/bin/chromium
    python tools/bench.py page --chromium /usr/bin/chromium --apart 1

Who looks: nobody; a bare WebSocket client in another process, which reads and draws nothing; Chromium without a window
(needs Playwright). A browser without a GPU draws on the processor that plans, so it takes what a user's own machine
would not; the bare client tells what sending costs, and so does a browser that has its own processors (``--apart``,
Linux alone), as on another machine. Every measurement makes the same plans, from the start of the
episode, one after the other as fast as they can be made.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from shared.ports import free_port

BENCH = Path(__file__).parents[1] / "bench.py"
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


class Arrivals:
    """Counts messages between two lines on standard input and prints how many came a second."""

    def __init__(self):
        self.count, self.ended = 0, threading.Event()

    def run(self) -> None:
        """Answer lines until there are no more."""
        print("looking", flush=True)
        for _ in sys.stdin:
            first, begin = self.count, time.perf_counter()
            sys.stdin.readline()
            print((self.count - first) / (time.perf_counter() - begin), flush=True)
        self.ended.set()


def watch_bare(url: str) -> None:
    """Receive messages and do nothing with them."""
    from websockets.sync.client import connect

    arrivals = Arrivals()
    protocol = f"viser-v{version('viser')}"
    with connect(url.replace("http", "ws", 1), subprotocols=[protocol], max_size=None, compression=None) as page:
        page.recv()
        threading.Thread(target=arrivals.run).start()
        while not arrivals.ended.is_set():
            try:
                page.recv(timeout=0.1)
                arrivals.count += 1
            except TimeoutError:
                pass


def watch_chromium(url: str, executable: str) -> None:
    """Look at the page in Chromium."""
    from playwright.sync_api import sync_playwright

    arrivals = Arrivals()

    def came(_: object) -> None:
        arrivals.count += 1

    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=executable, args=FLAGS)
        page = browser.new_page(viewport={"width": 1000, "height": 600})
        page.on("websocket", lambda socket: socket.on("framereceived", came))
        page.goto(url)
        page.get_by_role("button", name="Reset").wait_for(timeout=60e3)
        threading.Thread(target=arrivals.run).start()
        while not arrivals.ended.is_set():
            page.wait_for_timeout(100)
        browser.close()


@contextmanager
def watcher(kind: str, url: str, chromium: str | None, apart: set[int]) -> Iterator[subprocess.Popen | None]:
    """A process that looks at the page, on its own processors if any are given; None without one."""
    if kind == "nobody":
        yield None
        return
    command = [sys.executable, BENCH, "page", "--watch", kind, "--chromium", str(chromium)]
    if apart:
        command = ["taskset", "-c", ",".join(map(str, apart)), *command]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1) as process:
        process.stdin.write(f"{url}\n")  # not as an argument: other users see those, and the token in it
        process.stdout.readline()
        yield process
        process.stdin.close()


def measure(session, steps: int, process: subprocess.Popen | None) -> tuple[float, float]:
    """Plans per second over the first steps of an episode, and messages per second that arrived (NaN for nobody)."""
    episode = session.snapshot.episode
    session.reset()
    while session.snapshot.episode == episode:
        time.sleep(0.001)
    if process is not None:
        process.stdin.write("begin\n")
    first, begin = session.snapshot.steps, time.perf_counter()
    while session.snapshot.steps < steps:
        time.sleep(0.005)
    rate = (session.snapshot.steps - first) / (time.perf_counter() - begin)
    if process is None:
        return rate, float("nan")
    process.stdin.write("end\n")
    return rate, float(process.stdout.readline())


def main(arguments: list[str]) -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="omni_push_box")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE")
    parser.add_argument("--steps", type=int, default=100, help="plans of every measurement")
    parser.add_argument("--rounds", type=int, default=5, help="measurements of each, in turn; medians are printed")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--chromium", help="path of Chromium; not measured without")
    parser.add_argument(
        "--apart", type=int, default=0, metavar="N", help="processors for the browser, apart from the planner's"
    )
    parser.add_argument("--watch", choices=["bare", "chromium"], help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.watch == "bare":
        watch_bare(sys.stdin.readline().strip())
        return
    if options.watch == "chromium":
        watch_chromium(sys.stdin.readline().strip(), options.chromium)
        return

    apart: set[int] = set()
    if options.apart:
        all_cpus = sorted(os.sched_getaffinity(0))
        if options.apart >= len(all_cpus):
            parser.error(f"--apart {options.apart} leaves the planner none of {len(all_cpus)} processors")
        apart = set(all_cpus[-options.apart :])
        os.sched_setaffinity(0, set(all_cpus) - apart)

    from warpmpc.extras.live.page import Access, serve
    from warpmpc.extras.live.session import Session

    port = free_port()
    session = Session(options.scene, overrides=options.overrides, device=options.device, pace=1e6)
    ending = threading.Event()
    access = Access("127.0.0.1", port)
    page = threading.Thread(target=serve, args=(session, access), kwargs={"ending": ending})
    page.start()
    kinds = ["nobody", "bare", *(["chromium"] if options.chromium else [])]
    found: dict[str, list[tuple[float, float]]] = {kind: [] for kind in kinds}
    time.sleep(2.0)
    for _ in range(options.rounds):
        for kind in kinds:
            with watcher(kind, access.url, options.chromium, apart) as process:
                found[kind].append(measure(session, options.steps, process))
    ending.set()
    page.join()
    alone = statistics.median(rate for rate, _ in found["nobody"])
    print(f"{'who looks':10} {'plans/s':>8} {'loss':>7} {'updates/s':>10}")
    for kind, rows in found.items():
        rate, arrived = (statistics.median(column) for column in zip(*rows, strict=True))
        print(f"{kind:10} {rate:8.1f} {1.0 - rate / alone:7.1%} {arrived:10.1f}")
