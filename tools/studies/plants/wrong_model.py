# SPDX-License-Identifier: Apache-2.0
"""Plan with a wrong model: scenes whose plant differs from what the planner takes it to be, over seeds.

    python tools/study.py wrong_model --jobs 16 --limit 460
    python tools/study.py wrong_model --scenes quadruped_walk omni_push_box --runs 3

The planner keeps the scene's own model throughout. The plant is that model (``nominal``), or masses or frictions in it
are 30 % off, the dimensions of objects 10 % (``plant.factor``), or what is observed is 20, 40 or 80 ms old
(``plant.delay``). Properties are those of the objects where a scene has any, else of the robots, friction of the ground
as well. Nothing else is drawn in the plant. Delays that are no whole number of a scene's controls are left out.

A line has the seeds that reached the goal, the median time of these, and what the scene's terms cost in the plant: the
mean over the control steps until the episode ended, then over the seeds. What is done is kept in OUT/wrong_model.jsonl,
so that the same command goes on after an interruption or --limit, whose table has what is done by then.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np
from shared.machine import machine

import warpmpc
from studies.equal_time.cells import drive
from studies.equal_time.planners import DAY, gather
from warpmpc.cli.setup import start_warp
from warpmpc.loop.run.workers import FORMS, FinishedJobs, open_workers, scene_digest

SCENES = ("humanoid_get_up", "humanoid_stand", "quadruped_walk", "quadruped_terrain", "omni_push_box")
FACTORS = {"mass": (1.3, 0.7), "friction": (1.3, 0.7), "size": (1.1, 0.9)}
DELAYS = (0.02, 0.04, 0.08)
NOMINAL = "nominal"


@dataclass(frozen=True, kw_only=True)
class Episode:
    """An episode with a plant that is not what the planner takes it to be."""

    task: str
    strategy: str
    """What is wrong, in words."""
    overrides: tuple[str, ...]
    seed: int

    @cached_property
    def scene(self) -> warpmpc.Scene:
        """The scene with its plant, planned on one thread."""
        return warpmpc.load_scene(self.task, overrides=("plant.randomize=false", "engine.threads=1", *self.overrides))

    @property
    def seconds(self) -> float:
        """Time-out of the scene [s]."""
        return self.scene.timing.timeout

    def key(self, what: str) -> str:
        """What tells its record from others'."""
        return json.dumps([what, *asdict(self).values(), scene_digest(self.scene)])


def settings(task: str) -> dict[str, tuple[str, ...]]:
    """What is wrong, in words, and the overrides of a scene that make it so.

    Raises:
        SceneError: If there is no such scene.
    """
    scene = warpmpc.load_scene(task)
    sized = [item for item in scene.object if item.size is not None]
    things = [item.name for item in scene.object or scene.robot]
    touched = things if scene.object or scene.ground is None else [*things, "ground"]
    of = {"mass": things, "friction": touched, "size": [item.name for item in sized]}
    found = {NOMINAL: ()}
    for what, factors in FACTORS.items():
        for factor in factors if of[what] else ():
            changes = [f"plant.factor.{name}.{what}={factor}" for name in of[what]]
            for item in sized if what == "size" else ():  # stands where it stood, and not in the floor
                lift = (factor - 1.0) * item.size[-1] * (1.0 if len(item.size) == 1 else 0.5)
                changes.append(f"object.{item.name}.position={[*item.position[:2], item.position[2] + lift]}")
            found[f"{what} {100 * (factor - 1):+.0f} %"] = tuple(changes)
    for delay in DELAYS:
        controls = delay / scene.timing.control_dt
        if abs(controls - round(controls)) < 1e-6:
            found[f"delay {1000 * delay:.0f} ms"] = (f"plant.delay={delay}",)
    return found


def run(episode: Episode) -> dict:
    """Drive one episode until it is over.

    Returns:
        ``reached``, when the goal was [s], else None; ``cost``, the mean of the controls, None if the plant diverged.
    """
    costs, _, reached = drive(episode, to_the_end=False)
    return {"reached": reached, "cost": float(np.mean(costs)) if np.isfinite(costs).all() else None}


def lines(episodes: list[Episode], records: FinishedJobs) -> list[str]:
    """The table in Markdown, a line for each scene and setting with the episodes that are done."""
    cells: dict[tuple[str, str], list[dict | None]] = {}
    for episode in episodes:
        cells.setdefault((episode.task, episode.strategy), []).append(records.by_key.get(episode.key(run.__name__)))
    out = ["| scene | the plant beside the model | reached | time [s] | cost |", "|---|---|---|---|---|"]
    for (task, wrong), found in cells.items():
        done = [record for record in found if record]
        times, costs = ([record[key] for record in done if record[key] is not None] for key in ("reached", "cost"))
        figures = [f"{np.median(times):.2f}" if times else "-", f"{np.mean(costs):.3g}" if costs else "-"]
        out.append(f"| `{task}` | {wrong} | {len(times)} of {len(done)} | {' | '.join(figures)} |")
    return out


def main(arguments: list[str]) -> int:
    """Run the episodes that are missing, print the table; returns the exit code: 1 where --limit left some out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), metavar="SCENE")
    parser.add_argument("--runs", type=int, default=10, help="seeds (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--limit", type=float, default=DAY, help="stop after so many seconds")
    parser.add_argument("--out", type=Path, default=Path("build/results"), help="folder of the results")
    args, now = parser.parse_args(arguments), time.monotonic()
    episodes = [
        Episode(task=task, strategy=wrong, overrides=(*overrides, *args.overrides), seed=args.seed + i)
        for i, task in product(range(args.runs), args.scenes)
        for wrong, overrides in settings(task).items()
    ]
    records = FinishedJobs(args.out / "wrong_model.jsonl")
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    with workers:
        whole = gather(run, episodes, records, workers, until=now + args.limit)
    here = machine()
    print(f"{here['cpu']}, {here['cores']} cores, seeds from {args.seed} on", "", *lines(episodes, records), sep="\n")
    return 0 if whole else 1
