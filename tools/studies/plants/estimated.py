# SPDX-License-Identifier: Apache-2.0
"""Control from measured states: scenes with true, measured and estimated states, over seeds.

    python tools/study.py estimated --jobs 16 --limit 460
    python tools/study.py estimated --scenes omni_push_box:measured --seeds 0:20 --states measured physics

A scene's variant says what the plant's sensors measure (``plant.sensor``) and how it is estimated (``estimate``). It is
run with ``true`` states, which nothing measures; with those that were ``measured`` last and the velocities between the
last two; and with those of two filters, one of a nearly ``constant_velocity`` and one that moves by ``physics``. The
variant has the better one. With ``estimate_base`` there are ``true`` states, at once, and ``estimated`` ones, late as
``plant.delay`` says and predicted to the present.

A line has the seeds that ended with success; the median, least and most goals in a row where a scene has goals one
after the other, else the median time of successes; the root mean square of the errors of position and rotation that
the planner saw (of a base those of its tilt and velocity, and how far it had drifted at the end); and how the others
ended. What is done is kept in OUT/estimated.jsonl, so that the same command goes on
after an interruption or --limit, whose table has what is done by then.
"""

from __future__ import annotations

import argparse
import json
import shlex
import time
from collections import Counter
from dataclasses import asdict, dataclass
from datetime import date
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from shared.base_errors import BaseErrors
from shared.files import put_group
from shared.machine import machine

import warpmpc
from studies.equal_time.planners import DAY, gather
from warpmpc.cli.setup import start_warp
from warpmpc.loop.estimation.free_joints import FreeJoint
from warpmpc.loop.run.workers import FORMS, FinishedJobs, open_workers, scene_digest
from warpmpc.scene.schema import PoseModel, ProcessNoise, Sensors

FILTERS = (PoseModel.CONSTANT_VELOCITY,)
SCENES = {"omni_push_box:measured": ((0.5, 1.0),), "hand_cube:measured": ((1.0, 20.0),)}
"""Scenes, and the process noise of each of their filters: ``linear``, ``angular``; chosen on tuning seeds."""
BASES = ("go2_walk:estimated",)
"""Scenes whose base is estimated."""
STATES = ("true", "measured", *(model.value for model in FILTERS), "estimated")
COLUMNS = ["scene", "states", "reached", "goals or time", "error", "otherwise"]
OFF = ("position", "rotation")
"""Errors of things."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """An episode whose planner is shown one kind of states."""

    task: str
    strategy: str
    """The kind of states."""
    overrides: tuple[str, ...]
    seed: int

    @cached_property
    def scene(self) -> warpmpc.Scene:
        """The scene with these states, planned on one thread."""
        scene = warpmpc.load_scene(self.task, overrides=("engine.threads=1", *self.overrides))
        changes: dict[str, object] = {}
        if self.strategy == "true":
            late = {"delay": 0.0} if scene.estimate_base else {}
            changes["plant"] = scene.plant.model_copy(update={"sensor": Sensors(), **late})
            changes["estimate_base"] = {}
        if self.strategy in ("true", "measured"):
            changes["estimate"] = {}
        for model, (linear, angular) in zip(FILTERS, SCENES.get(self.task, ()), strict=False):
            if self.strategy == model.value:
                wanted = {"model": model, "process": ProcessNoise(linear=linear, angular=angular)}
                changes["estimate"] = {name: part.model_copy(update=wanted) for name, part in scene.estimate.items()}
        return scene.model_copy(update=changes)

    def key(self, what: str) -> str:
        """What tells its record from others'."""
        return json.dumps([what, *asdict(self).values(), scene_digest(self.scene)])


def run(job: Run) -> dict:
    """Run one episode until it is over.

    Returns:
        ``success``, ``reason``, ``time`` [s], ``reached`` (goals in a row, None where there is one), ``position`` [m]
        and ``rotation`` [rad], the root mean square of errors over time and things; those of
        :meth:`BaseErrors.result` for an estimated base.
    """
    from warpmpc.loop.run.episode import Episode

    episode, errors = Episode(job.scene, seed=job.seed, device="cpu"), []
    plant, known = episode.plant, warpmpc.load_scene(job.task)
    joints = [FreeJoint.of(plant.layout, name, key="estimate") for name in known.plant.sensor.pose]
    bases = [BaseErrors(FreeJoint.of(plant.layout, name, key="estimate_base")) for name in known.estimate_base]
    observe = episode.observe

    def watched() -> warpmpc.State:
        seen, true = observe(), plant.state
        for joint in joints:
            place = seen.joint_q[joint.q][:3] - true.joint_q[joint.q][:3]
            turns = (Rotation.from_quat(state.joint_q[joint.q][3:]) for state in (seen, true))
            errors.append((place @ place, (next(turns).inv() * next(turns)).magnitude() ** 2))
        for base in bases:
            base.note(seen, true)
        return seen

    episode.observe = watched
    result = episode.run()
    off = bases[0].result() if bases else dict(zip(OFF, np.sqrt(np.mean(errors, axis=0)).tolist(), strict=True))
    return {
        "success": result.success,
        "reason": result.reason,
        "time": result.sim_time,
        "reached": result.reached,
        **off,
    }


def rows(jobs: list[Run], records: FinishedJobs) -> list[list[str]]:
    """Cells of the table, a row for each scene and kind of states with the episodes that are done."""
    cells: dict[tuple[str, str], list[dict]] = {}
    for job in jobs:
        done = cells.setdefault((job.task, job.strategy), [])
        if record := records.by_key.get(job.key(run.__name__)):
            done.append(record)
    out = []
    for (task, kind), done in cells.items():
        passed, goals = [r["time"] for r in done if r["success"]], [r["reached"] for r in done]
        figure = f"{np.median(passed):.1f} s" if passed else "-"
        if done and None not in goals:
            figure = f"{np.median(goals):g} ({min(goals)} to {max(goals)})"
        error = "-"
        if done and "tilt" in done[0]:
            error = BaseErrors.text(done)
        elif done:
            place, turn = (np.sqrt(np.mean([r[key] ** 2 for r in done])) for key in OFF)
            error = f"{1e3 * place:.1f} mm, {np.degrees(turn):.1f}°"
        ends = Counter(r["reason"] for r in done if not r["success"])
        otherwise = ", ".join(f"{count} {reason}" for reason, count in ends.most_common()) or "-"
        out.append([f"`{task}`", kind, f"{len(passed)} of {len(done)}", figure, error, otherwise])
    return out


def seed_range(text: str) -> range:
    """Seeds A to B - 1 of ``A:B``."""
    first, last = text.split(":")
    return range(int(first), int(last))


def main(arguments: list[str]) -> int:
    """Run the episodes that are missing, print the table; returns the exit code: 1 where --limit left some out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[*SCENES, *BASES], metavar="SCENE")
    parser.add_argument("--states", nargs="+", default=list(STATES), choices=STATES)
    parser.add_argument("--seeds", type=seed_range, default=range(10), metavar="A:B", help="seeds A to B - 1 (0:10)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--limit", type=float, default=DAY, help="stop after so many seconds")
    parser.add_argument("--out", type=Path, default=Path("build/results"), help="folder of the results")
    parser.add_argument("--json", type=Path, metavar="FILE", help="put the figures there, as docs/data has them")
    args, now = parser.parse_args(arguments), time.monotonic()
    jobs = [
        Run(task=task, strategy=kind, overrides=tuple(args.overrides), seed=seed)
        for seed, task in product(args.seeds, args.scenes)
        for kind in args.states
        if kind in (("true", "estimated") if task in BASES else STATES[:-1])
    ]
    records = FinishedJobs(args.out / "estimated.jsonl")
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    with workers:
        whole = gather(run, jobs, records, workers, until=now + args.limit)
    here, found = machine(), rows(jobs, records)
    about = f"{here['cpu']}, {here['cores']} cores, seeds {args.seeds.start} to {args.seeds.stop - 1}"
    print(about, "", *(f"| {' | '.join(row)} |" for row in (COLUMNS, ["---"] * len(COLUMNS), *found)), sep="\n")
    if args.json:
        command = shlex.join(["python", "tools/study.py", "estimated", *arguments])
        put_group(
            args.json, COLUMNS, {"machine": about, "date": date.today().isoformat(), "command": command, "rows": found}
        )
    return 0 if whole else 1
