# SPDX-License-Identifier: Apache-2.0
"""Plan with a cloned policy's proposal among the samples: are fewer of them enough?

    python tools/study.py imitation --jobs 16
    python tools/study.py imitation --seeds 0:4 --samples 8 64

A quadrotor flies to drawn places. First ``warpmpc run --export`` makes a data set of the planner's successful episodes
(--demos, tuning seeds from 100 on), from which ``examples/imitate.py`` clones a policy; both stay in OUT. Then every
seed is flown with every number of samples, without and with the policy as ``planner.ancillary``, and by the policy
alone. An episode goes on to its end although the goal was reached; its cost is the mean over its control steps of what
the scene's terms cost in the plant.

A line has the seeds that reached the goal, the median time of these, and the cost: mean over seeds ± Student's t, 95 %.
What is done is kept in OUT/imitation.jsonl, so that the same command goes on after an interruption or --limit.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from itertools import product
from pathlib import Path

import numpy as np
from shared.files import put_group
from shared.intervals import mean
from shared.machine import machine

import warpmpc
from studies.equal_time import cells
from studies.equal_time.planners import DAY, gather
from warpmpc.cli.setup import start_warp
from warpmpc.loop.run.workers import FORMS, FinishedJobs, open_workers, scene_digest

SCENE = "quadrotor"
SAMPLES = (8, 16, 32, 64, 128, 256)
FIRST_DEMO = 100
OBSERVED = ("joint_q", "joint_qd", "goal")
PROGRAM = Path(__file__).parents[3] / "examples" / "imitate.py"
COLUMNS = ["samples", "reached", "time [s]", "cost", "reached with the policy", "time [s]", "cost", "plan [ms]"]


@dataclass(frozen=True, kw_only=True)
class Flight:
    """One episode."""

    samples: int
    """Samples of a plan; 0 for the policy alone."""
    seed: int
    policy: str | None = None
    task = SCENE

    @property
    def strategy(self) -> str:
        """How it flies, in words."""
        planner = f"{self.samples} samples" if self.samples else ""
        return " and ".join(filter(None, (planner, self.policy and "the policy")))

    @property
    def scene(self) -> warpmpc.Scene:
        """The scene as it is planned, on one thread."""
        own = [f"planner.samples={self.samples or SAMPLES[0]}", "engine.threads=1"]
        if self.policy is not None:
            wanted = f'{{policy = "{self.policy}", observation = {json.dumps(OBSERVED)}}}'
            own.append(f"planner.ancillary=[{wanted}]")
        return warpmpc.load_scene(SCENE, overrides=own)

    @property
    def seconds(self) -> float:
        """How long it takes [s]."""
        return self.scene.timing.timeout

    def key(self, what: str) -> str:
        """What tells its record from others'."""
        return json.dumps([what, self.samples, self.seed, scene_digest(self.scene)])


def fly(flight: Flight) -> dict:
    """Fly one episode to its end: ``cost``, ``reached`` [s] and ``plan_ms``, of planner or policy."""
    return cells.run(flight) if flight.samples else alone(flight)


def alone(flight: Flight) -> dict:
    """Fly one episode by the policy's first control."""
    import onnxruntime

    from warpmpc.scene.draw import draw_task

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    policy = onnxruntime.InferenceSession(flight.policy, options)
    scene, _ = draw_task(flight.scene, flight.seed)
    task, costs, taken, reached = warpmpc.Task(scene), [], [], None
    plant = warpmpc.Plant(scene, seed=flight.seed, task=task, watch=scene.cost_labels)
    while plant.time < flight.seconds - 1e-9 and not plant.diverged:
        state, begin = plant.observe(), time.perf_counter()
        x = np.concatenate([state.joint_q, state.joint_qd, task["goal"]]).astype(np.float32)
        plant.apply(policy.run(None, {"x": x[None]})[0][0, 0])
        taken.append(1e3 * (time.perf_counter() - begin))
        costs.append(sum(float(task[label]) * value for label, value in plant.terms.items()))
        reached = plant.time if reached is None and plant.success else reached
    cost = None if plant.diverged else float(np.mean(costs))
    return {"cost": cost, "reached": reached, "plan_ms": float(np.median(taken))}


def clone(demos: int, jobs: str, out: Path) -> str:
    """The policy of a data set of so many episodes; both are made where they are not there.

    Raises:
        subprocess.CalledProcessError: If one cannot be made.
    """
    data, policy = out / f"imitation_{demos}.hdf5", out / f"imitation_{demos}.onnx"
    if not data.exists():
        part = data.with_name(f"part_{data.name}")
        part.unlink(missing_ok=True)
        run = [sys.executable, "-m", "warpmpc.cli.main", "run", SCENE, "--seed", str(FIRST_DEMO), "--jobs", jobs]
        run += ["--episodes", str(demos), "--export", str(part)]
        subprocess.run(run, check=False)  # 1 where one failed
        part.rename(data)
    if not policy.exists():
        subprocess.run([sys.executable, str(PROGRAM), SCENE, str(data), str(policy)], check=True)
    return str(policy.absolute())


def rows(flights: Sequence[Flight], records: FinishedJobs) -> list[list[str]]:
    """Cells of the table, a row for each number of samples with the flights that are done."""

    def figures(samples: int, with_policy: bool) -> tuple[list[str], str]:
        part = [f for f in flights if f.samples == samples and (f.policy is not None) == with_policy]
        done = [records.by_key[key] for f in part if (key := f.key(fly.__name__)) in records.by_key]
        times, costs = ([record[key] for record in done if record[key] is not None] for key in ("reached", "cost"))
        if not done:
            return ["-", "-", "-"], "-"
        found = [f"{len(times)} of {len(done)}", f"{np.median(times):.2f}" if times else "-", "-"]
        if costs:
            cost = mean(costs)
            found[2] = f"{cost.value:.2f}" + ("" if cost.low is None else f" ± {cost.value - cost.low:.2f}")
        return found, f"{np.median([record['plan_ms'] for record in done]):.2g}"

    out = []
    for samples in dict.fromkeys(flight.samples for flight in flights):
        without, (proposed, taken) = figures(samples, False)[0], figures(samples, True)
        out.append([str(samples) if samples else "the policy alone", *without, *proposed, taken])
    return out


def main(arguments: list[str]) -> int:
    """Run what is missing, print the table; returns the exit code: 1 where --limit left some out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", nargs="+", type=int, default=list(SAMPLES), metavar="N")
    parser.add_argument("--seeds", default="0:10", metavar="FIRST:LAST", help="seeds of the flights (default 0:10)")
    parser.add_argument("--demos", type=int, default=100, help="episodes of the data set (default 100)")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--limit", type=float, default=DAY, help="stop after so many seconds")
    parser.add_argument("--out", type=Path, default=Path("build/results"), help="folder of the results")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table's figures, as docs/data has them")
    args, now = parser.parse_args(arguments), time.monotonic()
    args.out.mkdir(parents=True, exist_ok=True)
    policy = clone(args.demos, args.jobs, args.out)
    seeds = range(*map(int, args.seeds.split(":")))
    flights = [
        Flight(samples=samples, seed=seed, policy=used)
        for seed, samples in product(seeds, args.samples)
        for used in (None, policy)
    ]
    flights += [Flight(samples=0, seed=seed, policy=policy) for seed in seeds]
    records = FinishedJobs(args.out / "imitation.jsonl")
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    with workers:
        whole = gather(fly, flights, records, workers, until=now + args.limit)
    here, found = machine(), rows(flights, records)
    about = f"{here['cpu']}, {here['cores']} cores, seeds {seeds[0]} to {seeds[-1]}"
    print(about, "", *(f"| {' | '.join(row)} |" for row in (COLUMNS, ["---"] * len(COLUMNS), *found)), sep="\n")
    if args.json:
        command = shlex.join(["python", "tools/study.py", "imitation", *arguments])
        group = {"machine": about, "date": date.today().isoformat(), "command": command, "rows": found}
        put_group(args.json, COLUMNS, group)
    return 0 if whole else 1
