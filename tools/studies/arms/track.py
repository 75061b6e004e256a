# SPDX-License-Identifier: Apache-2.0
"""Lets arms follow what moves, and says how closely they did, what they touched and how near they came to the rest.

    python tools/study.py track storm_track storm_track:walls storm_hold_orientation --seeds 100:110 --jobs 2
    python tools/study.py track storm_track storm_hold_orientation --osc    # operational-space control instead
    python tools/study.py track storm_track storm_track:walls --draw docs/storm_track.png    # of earlier runs' npz

OUT/track.jsonl has a line for every run, OUT/SCENE.npz what its first run did at every step. A motion
that waits is asked how near the hand came in the second half of the wait, beside the nearest that any posture comes
which touches nothing (random search, solid links), and how long after the wait it is at the ball again.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation
from shared.files import put_rows
from shared.measure import Clearance

import warpmpc
from studies.arms.arm import Arm
from studies.arms.osc import follow, with_torques
from warpmpc.loop.run.episode import Episode
from warpmpc.scene.model.compiled import compile_scene

if TYPE_CHECKING:
    from warpmpc import Plant, Scene
    from warpmpc.scene.schema import Motion

LAWS = {"": ("planner", "k", "C1"), "_osc": ("OSC", "0.55", "#f4cf9f")}
"""Ends of the files' names: what a legend says, colours of the hand's distance and the arm's."""
SETTLED = 2.0
"""When a run begins to count [s]: the hand starts elsewhere."""
NEAR = 0.03
"""Distance at which the hand is at the ball again [m]."""


class Watch:
    """Takes down what one run does.

    Args:
        plant: Its plant.
    """

    def __init__(self, plant: Plant):
        self.arm, self._clearance = Arm(plant.scene, plant.compiled), Clearance(plant.compiled)
        self.rows: dict[str, list] = defaultdict(list)
        self.own: set[str] = set()

    def __call__(self, controller: object, plant: Plant, control: np.ndarray) -> None:
        """Take note of a step."""
        q = plant.state.joint_q[self.arm.dofs].astype(float)
        moved = {f"movable/{name}" for name in plant.layout.movable} | {"world"}
        self.own |= {"-".join(pair) for pair in self.arm.touching(q) if not moved & {*pair}}
        values = {
            "time": plant.time,
            "goal": plant.goal,
            "seen": controller.task["goal"],
            "tool": self.arm.tool(q),
            "qd": plant.state.joint_qd[self.arm.dofs],
            "clearance": self._clearance.of(plant),
        }
        for name, value in values.items():
            self.rows[name].append(value)

    def arrays(self) -> dict[str, np.ndarray]:
        """What was taken down, by name ``[n, ...]``."""
        return {name: np.array(rows) for name, rows in self.rows.items()}


def waits(motion: Motion) -> list[tuple[float, float, tuple[float, ...]]]:
    """Begin and end of every wait of a motion within its first round [s], and where."""
    times = motion.times or ()
    rows = zip(times, times[1:], motion.through, motion.through[1:], strict=False)
    return [(motion.start + t, motion.start + u, p) for t, u, p, q in rows if p == q]


def nearest(arm: Arm, point: np.ndarray, *, starts: int = 400, steps: int = 600) -> float:
    """How near the tool comes to a point in any posture that touches nothing, by random search [m]."""
    rng, width = np.random.default_rng(0), arm.upper - arm.lower

    def distance(q: np.ndarray) -> float:
        return float(np.linalg.norm(arm.tool(q)[:3] - point))

    postures = [q for q in rng.uniform(arm.lower, arm.upper, (starts, len(width))) if not arm.touching(q)]
    found = []
    for q in sorted(postures, key=distance)[:8]:
        best = distance(q)
        for step in range(steps):
            spread = 0.2 * 0.005 ** (step / steps)
            candidate = np.clip(q + spread * width * rng.normal(size=len(q)), arm.lower, arm.upper)
            if (d := distance(candidate)) < best and not arm.touching(candidate):
                q, best = candidate, d
        found.append(best)
    return min(found)


@cache
def nearest_of(scene: str, overrides: tuple[str, ...]) -> list[float]:
    """How near the tool can come to the goal in each of its waits [m]."""
    loaded = warpmpc.load_scene(scene, overrides=overrides)
    arm = Arm(loaded, compile_scene(loaded))
    return [nearest(arm, np.array(point)) for motion in _goal(loaded) for _, _, point in waits(motion)]


def _goal(scene: Scene) -> list[Motion]:
    return [motion for motion in scene.motion if motion.name == "goal"]


def run(name: str, seed: int, overrides: tuple[str, ...], keep: Path | None, *, osc: bool = False) -> dict:
    """One run, by the scene's planner or by operational-space control."""
    from warpmpc.cli.setup import start_warp

    start_warp()
    before, dt = time.process_time(), warpmpc.load_scene(name, overrides=overrides).timing.control_dt
    if osc:
        plant, watch, plan_ms = follow(with_torques(name, overrides), seed, Watch)
    else:
        episode = Episode(warpmpc.load_scene(name, overrides=overrides), seed=seed)
        plant, watch = episode.plant, Watch(episode.plant)
        plan_ms = episode.run(on_step=watch).plan_ms["p50"]
    rows = watch.arrays()
    if keep:
        np.savez_compressed(keep, **rows)
    at, count = rows["time"], rows["time"] > SETTLED
    miss = np.linalg.norm(rows["tool"][:, :3] - rows["goal"][:, :3], axis=1)
    dot = np.abs((rows["tool"][:, 3:] * rows["goal"][:, 3:]).sum(axis=1)).clip(max=1.0)
    turn = (Rotation.from_quat(rows["tool"][:, 3:]).inv() * Rotation.from_quat(rows["goal"][:, 3:])).magnitude()
    stops = []
    for motion in _goal(plant.scene):
        for (begin, end, place), limit in zip(waits(motion), nearest_of(name, overrides), strict=True):
            after = np.flatnonzero((at > end) & (miss < NEAR))
            still = miss[(at > 0.5 * (begin + end)) & (at <= end)]
            back = float(at[after[0]] - end) if len(after) else None
            stops.append({"place": place, "came_m": float(np.median(still)), "nearest_m": limit, "back_s": back})
    jerk = np.diff(rows["qd"], 2, axis=0) / dt**2
    return {
        "scene": f"{name}, OSC" if osc else name,
        "seed": seed,
        "overrides": overrides,
        "error_m": [float(np.median(miss[count])), float(np.percentile(miss[count], 95)), float(miss[count].max())],
        "rotation_percent": [float(f(100.0 * (1.0 - dot[count]))) for f in (np.median, np.max)],
        "rotation_rad": [float(f(turn[count])) for f in (np.median, np.max)],
        "oriented": plant.scene.goal.rotation is not None,
        "force_N": plant.contact.max_force,
        "contact_s": plant.contact.time,
        "own_links": sorted(watch.own),
        "clearance_m": float(rows["clearance"].min()),
        "jerk_rms": float(np.sqrt((jerk**2).mean())),
        "stops": stops,
        "plan_ms": plan_ms,
        "cpu_s": time.process_time() - before,
    }


def shown(rows: list[dict]) -> Table:
    """A table with one line for every scene."""
    table = Table(box=None)
    heads = ("scene", "runs", "error: median, p95, max [mm]", "rotation: median, max [%], [°]", "touched, max [N]")
    for head in (*heads, "own links", "clearance [mm]", "jerk [rad/s³]"):
        table.add_column(head)
    for name in dict.fromkeys(row["scene"] for row in rows):
        of = [row for row in rows if row["scene"] == name]
        error = 1e3 * np.array([row["error_m"] for row in of])
        percent, turn = np.array([row["rotation_percent"] for row in of]), [row["rotation_rad"] for row in of]
        turn = np.degrees(turn)
        touched = [row["force_N"] for row in of if row["force_N"] > 0.0]
        table.add_row(
            name,
            str(len(of)),
            f"{np.median(error[:, 0]):.1f}, {np.median(error[:, 1]):.1f}, {error[:, 2].max():.1f}",
            f"{np.median(percent[:, 0]):.3f}, {percent[:, 1].max():.3f}; {np.median(turn[:, 0]):.1f}, "
            f"{turn[:, 1].max():.1f}"
            if of[0]["oriented"]
            else "–",
            f"{len(touched)}, {max(touched, default=0.0):.1f}",
            str(sum(bool(row["own_links"]) for row in of)),
            f"{1e3 * min(row['clearance_m'] for row in of):.1f}",
            f"{np.median([row['jerk_rms'] for row in of]):.0f}",
        )
    return table


def stops_shown(rows: list[dict]) -> Table:
    """A table with one line for every wait of every scene."""
    table = Table(box=None)
    for head in (
        "scene",
        "wait",
        "came within: median, max [mm]",
        "nearest there is [mm]",
        "back: median, max [s]",
        "not back",
    ):
        table.add_column(head)
    for name in dict.fromkeys(row["scene"] for row in rows if row["stops"]):
        of = [row["stops"] for row in rows if row["scene"] == name]
        for i, stops in enumerate(zip(*of, strict=True)):
            came = 1e3 * np.array([stop["came_m"] for stop in stops])
            back = [stop["back_s"] for stop in stops if stop["back_s"] is not None]
            table.add_row(
                name,
                str(i + 1),
                f"{np.median(came):.0f}, {came.max():.0f}",
                f"{1e3 * stops[0]['nearest_m']:.0f}",
                f"{np.median(back):.2f}, {max(back):.2f}" if back else "–",
                str(len(stops) - len(back)),
            )
    return table


ERRORS = ("scene", "error: median, p95, largest [mm]", "orientation: median, largest", "runs with contact")
ERRORS = (*ERRORS, "least clearance [mm]")
WAITS = ("the ball waits at [m]", "hand came within: median, largest [mm]", "nearest there is [mm]")
WAITS = (*WAITS, "at the ball again after: median, largest [s]", "never")
"""Columns of ``docs/data``."""


def figures(rows: list[dict]) -> tuple[list[list[str]], list[list[str]]]:
    """Rows of ``docs/data``: a line for every scene, and one for every wait of the first scene that has any."""
    found = []
    for table in (shown(rows), stops_shown(rows)):
        columns = [list(map(str, column.cells)) for column in table.columns]
        found.append([list(row) for row in zip(*columns, strict=True)])
    errors = []
    for name, runs, error, turned, touched, _, clearance, _ in found[0]:
        free = "free"
        if ";" in turned:
            (percent, most), (angle, widest) = (part.split(", ") for part in turned.split("; "))
            free = f"{percent} %, {most} % ({angle}°, {widest}°)"
        scene = name if "OSC" not in name else name.removesuffix(", OSC")
        law = ", OSC" * ("OSC" in name)
        errors.append([f"`{scene}`{law}", error, free, f"{touched.split(',')[0]} of {runs}", clearance])
    first = next((row["stops"] for row in rows if row["stops"]), [])
    places = ["({:g}, {:g}, {:g})".format(*stop["place"]) for stop in first]
    return errors, [[place, *line[2:]] for place, line in zip(places, found[1], strict=False)]


def draw(folder: Path, scenes: list[str], path: Path) -> None:
    """Draw the first run of each scene, by the planner and, where there is one, by operational-space control.

    Args:
        folder: Holds SCENE.npz and SCENE_osc.npz of ``study.py track``.
        scenes: Names of the scenes, as they were run.
        path: Where the picture goes.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.2 * len(scenes), 5.2), layout="constrained")
    rows = figure.subplots(2, len(scenes), squeeze=False, sharex="col")
    for (upper, lower), scene in zip(rows.T, scenes, strict=True):
        for end, (law, hand, arm) in LAWS.items():
            file = folder / f"{scene.replace(':', '_')}{end}.npz"
            if end and not file.exists():
                continue
            run = dict(np.load(file))
            time, tool, goal = run["time"], run["tool"][:, :3], run["goal"][:, :3]
            if not end:
                for i, (axis, color) in enumerate(zip("xyz", ("C3", "C2", "C0"), strict=True)):
                    upper.plot(time, goal[:, i], color=color, linestyle="--", linewidth=0.8)
                    upper.plot(time, tool[:, i], color=color, label=axis)
            miss, near = np.linalg.norm(tool - goal, axis=1), run["clearance"].clip(min=1e-4)
            lower.plot(time, 1e3 * miss, color=hand, label=f"hand to ball, {law}")
            lower.plot(time, 1e3 * near, color=arm, label=f"arm to obstacles, {law}")
        upper.set(title=scene, ylabel="ball (dashed), hand [m]")
        lower.set(xlabel="time [s]", ylabel="distance [mm]", yscale="log", ylim=(1.0, 500.0))
        for axes in (upper, lower):
            axes.grid(alpha=0.3)
            axes.legend(loc="upper right", fontsize="x-small", ncols=2)
    figure.savefig(path, dpi=100)


def main(arguments: list[str]) -> None:
    """Run, print, and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--seeds", default="0:10", help="first:end (default 0:10)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--osc", action="store_true", help="operational-space control in place of the planner")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time, on one thread each")
    parser.add_argument("--out", type=Path, default=Path("build/track"))
    parser.add_argument("--draw", type=Path, metavar="PNG", help="draw earlier runs in OUT, both ways, and run nothing")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table's figures, as docs/data has them")
    parser.add_argument("--waits", type=Path, metavar="FILE", help="write those of the ball's waits")
    args = parser.parse_args(arguments)
    if args.draw:
        draw(args.out, args.scenes, args.draw)
        return
    args.out.mkdir(parents=True, exist_ok=True)
    overrides, seeds = ("engine.threads=1", *args.overrides), range(*map(int, args.seeds.split(":")))
    rows = []
    with ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = [
            pool.submit(
                run,
                name,
                seed,
                overrides,
                args.out / f"{name.replace(':', '_')}{'_osc' * args.osc}.npz" if seed == seeds[0] else None,
                osc=args.osc,
            )
            for name in args.scenes
            for seed in seeds
        ]
        with (args.out / "track.jsonl").open("a") as file:
            for job in jobs:
                rows.append(job.result())
                print(json.dumps(rows[-1]), file=file, flush=True)
    console = Console(width=160)
    console.print(shown(rows))
    console.print(stops_shown(rows))
    for path, columns, found in zip((args.json, args.waits), (ERRORS, WAITS), figures(rows), strict=True):
        if path:
            put_rows(path, columns, found, study="track", arguments=arguments)
