# SPDX-License-Identifier: Apache-2.0
"""A robot and a planner as two processes that know messages of each other alone: runs, and what goes wrong.

    python tools/study.py wire --json docs/data
    python tools/study.py wire --transport zmq --scene cartpole_swingup --seeds 2 --speed 0.3

First every scene is run with several seeds, the robot on one side and `warpmpc run --real-time --robot` on the other;
then one of them over links that lose or delay messages. Then comes the drill: a robot on a long way whose
planner is killed or stopped, whose messages are spoilt, whom a second sender commands. Prints rows of two tables;
--json FOLDER writes them as wire_runs.json and wire_faults.json, for tools/pages/figures.py. All times are on the
robot's clock, as the robot measured them.
"""

from __future__ import annotations

import argparse
import datetime
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from shared.files import put_group
from shared.machine import machine
from shared.wire import TRANSPORTS, Drill, Planner, start_robot

SCENES = ("cartpole_swingup", "omni_push_box")
LINKS = {
    "5 % of messages lost": ("--drop", "0.05"),
    "30 % of messages lost": ("--drop", "0.3"),
    "each message 20 to 80 ms late": ("--delay", "20", "80"),
}
"""Links with faults, both ways."""
LOSSY = "omni_push_box"
"""Scene that is run over them."""
UNTOLD = 1e-6
"""Age below which commands have no stamp, as arrays of ROS: they count from when they came [ms]."""
MOMENT = 0.2
"""Time after which the robot is switched off when the planner has ended [s]."""
WINDOW = 0.5
"""Time for which messages go wrong [s]."""
SPOILT = {
    "NaN": "nan",
    "stamps 2 s ahead": "ahead",
    "stamps 2 s behind": "behind",
    "a joint's name missing": "nameless",
    "all joints missing": "silent",
}
"""Faults of messages, as the robot of a drill knows them."""
RUNS = [
    "transport, scene",
    "reached",
    "time [s]",
    "command period p50/p99/max [ms]",
    "observation to command [ms]",
]
FAULTS = ["what goes wrong", "transport", "safe after [ms]", "refused", "unsafe", "afterwards"]


@dataclass
class Outcome:
    """A fault and what became of it."""

    fault: str
    transport: str
    safe: float | None
    """Longest time to the safe command [s]; None where none is due."""
    unsafe: int
    """Unsafe commands."""
    refused: dict[str, int] = field(default_factory=dict)
    """Commands refused, by reason."""
    after: str = "goes on"

    def row(self) -> list[str]:
        """Cells of a table."""
        safe = "-" if self.safe is None else f"{1e3 * self.safe:.0f}"
        refused = ", ".join(f"{count} {kind}" for kind, count in self.refused.items() if count) or "0"
        return [self.fault, self.transport, safe, refused, str(self.unsafe), self.after]


def run_pair(
    scene: str,
    transport: str,
    seed: int,
    *,
    speed: float,
    link: Sequence[str] = (),
    options: Sequence[str] = (),
    changes: Sequence[str] = (),
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run an episode with the robot in a separate process; returns the planner's result and the robot's report.

    Args:
        scene: Scene and variant.
        transport: Name of the transport.
        seed: Seed of both.
        speed: The robot's seconds in a second.
        link: Options of the robot's side.
        options: Options of the planner's side.
        changes: ``KEY=VALUE`` of the scene on both sides.

    Raises:
        ValueError: If one of them failed.
    """
    ends = TRANSPORTS[transport]
    place, common = ends.place(), ["--seed", str(seed), *(part for change in changes for part in ("--set", change))]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{transport}.toml"
        file.write_text(ends.settings(place), encoding="utf-8")
        given = [*ends.options(place, file), "--speed", str(speed), *common, *link]
        robot = start_robot(scene, given, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        planner = Planner(scene, f"{ends.driver}:{file}", speed=speed, options=[*common, *options])
        try:
            result = planner.result(timeout=900.0)
            time.sleep(MOMENT / speed)  # it was commanded a little later than the planner began to count
            robot.send_signal(signal.SIGTERM)
            out, errors = robot.communicate(timeout=60.0)
        finally:
            planner.kill()
            robot.kill()
    if not out:
        raise ValueError(f"the robot ended without a report: {errors}")
    return result, json.loads(out)


def drill(transport: str, *, speed: float) -> Iterator[Outcome]:
    """Let everything go wrong, one thing after the other; the planner is killed last."""
    with tempfile.TemporaryDirectory() as folder, Drill(transport, Path(folder), speed=speed) as pair:
        for title, name in SPOILT.items():
            pair.order("await")
            yield _outcome(title, transport, pair.order(name, WINDOW))
        pair.order("await")
        pair.planner.send(signal.SIGSTOP)
        answer = pair.order("watch", WINDOW)
        pair.planner.send(signal.SIGCONT)
        yield _outcome("planner stopped", transport, answer)
        answer = pair.interfere(WINDOW)
        pair.order("await")
        yield _outcome("a second sender", transport, answer)
        pair.planner.send(signal.SIGKILL)
        killed = _outcome("planner killed", transport, pair.order("watch", WINDOW))
        pair.planner.kill()
        pair.planner = pair.start_planner()
        pair.order("await")
        killed.after = "follows a new planner"
        yield killed


def _outcome(title: str, transport: str, answer: dict[str, Any]) -> Outcome:
    return Outcome(title, transport, answer["safe_s"], answer["unsafe"], answer["refused"])


def lossy(transport: str, *, seeds: range, speed: float, changes: Sequence[str]) -> Iterator[Outcome]:
    """Run a scene over links with faults."""
    for title, link in LINKS.items():
        pairs = [run_pair(LOSSY, transport, seed, speed=speed, link=link, changes=changes) for seed in seeds]
        reports = [report for _, report in pairs]
        reached = sum(result["success"] and report["success"] for result, report in pairs)
        refused = sum((Counter(report["refused"]) for report in reports), Counter())
        unsafe, after = sum(report["unsafe"] for report in reports), f"goal in {reached} of {len(pairs)}"
        safe = max((report["safe_state_s"] for report in reports if report["safe_state_s"] is not None), default=None)
        yield Outcome(title, transport, safe, unsafe, dict(refused), after)


def runs(scene: str, transport: str, *, seeds: range, speed: float, changes: Sequence[str]) -> tuple[list[str], int]:
    """Cells of a table about a scene's runs, and the number of its unsafe commands."""
    pairs = [run_pair(scene, transport, seed, speed=speed, changes=changes) for seed in seeds]
    reports = [report for _, report in pairs]
    reached = sum(result["success"] and report["success"] for result, report in pairs)
    times = [result["sim_time_s"] for result, _ in pairs]
    cells = [
        f"{min(times):.1f} to {max(times):.1f}",
        *(_spread([report[k] for report in reports]) for k in ("period_ms", "age_ms")),
    ]
    return [f"{transport}, `{scene}`", f"{reached} of {len(pairs)}", *cells], sum(r["unsafe"] for r in reports)


def _spread(found: Sequence[dict[str, float]]) -> str:
    """Medians over runs of their p50 and p99, and the largest of all; a dash where messages do not tell it."""
    middle = sorted(found, key=lambda part: part["p99"])[len(found) // 2]
    largest = max(part["max"] for part in found)
    return f"{middle['p50']:.0f}/{middle['p99']:.0f}/{largest:.0f}" if largest > UNTOLD else "-"


def main(arguments: list[str]) -> int:
    """Print the tables; the exit code is 1 if anything was unsafe."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transport", nargs="+", default=[*TRANSPORTS], choices=TRANSPORTS)
    parser.add_argument("--scene", nargs="*", default=SCENES, help="scenes that are run")
    parser.add_argument("--seeds", type=int, default=5, help="runs of each scene, with seeds 0, 1, ...")
    parser.add_argument("--speed", type=float, default=1.0, help="the robot's seconds in a second")
    parser.add_argument("--part", nargs="*", default=["runs", "links", "drill"], choices=["runs", "links", "drill"])
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change the scenes of the runs")
    parser.add_argument("--json", type=Path, metavar="FOLDER", help="write wire_runs.json and wire_faults.json")
    options = parser.parse_args(arguments)
    seeds, speed = range(options.seeds), options.speed
    told, faults, unsafe = [], [], 0
    for transport in options.transport:
        for scene in options.scene if "runs" in options.part else ():
            row, bad = runs(scene, transport, seeds=seeds, speed=speed, changes=options.set)
            told.append(row)
            unsafe += bad
            print(" | ".join(row), flush=True)
        outcomes = chain(
            lossy(transport, seeds=seeds, speed=speed, changes=options.set) if "links" in options.part else (),
            drill(transport, speed=speed) if "drill" in options.part else (),
        )
        for outcome in outcomes:
            faults.append(outcome.row())
            unsafe += outcome.unsafe
            print(" | ".join(faults[-1]), flush=True)
    if options.json is not None:
        here = machine()
        facts = {
            "machine": f"{here['cpu']}, {here['cores']} cores",
            "date": datetime.date.today().isoformat(),
            "command": " ".join(["python tools/study.py wire", *arguments]),
        }
        for name, columns, rows in (("wire_runs", RUNS, told), ("wire_faults", FAULTS, faults)):
            put_group(options.json / f"{name}.json", columns, {**facts, "rows": rows})
    return int(unsafe > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
