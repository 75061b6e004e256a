# SPDX-License-Identifier: Apache-2.0
"""Path length and clearance in Table I (Pezzato et al. 2025, Figs. 3 and 4): ours, as in the paper, and baselines.

    python tools/study.py paths --runs 20 --seed 100086 --jobs 16              # point robot and Panda, every method
    python tools/study.py paths --runs 20 --seed 100086 --docs docs            # the page's table and picture, too
    python tools/study.py paths --fabrics ~/fabrics/bin/python                 # optimization fabrics beside them

Runs are those of ``tools/study.py reproduce table1``, kept in OUT/table1.jsonl: what is there is not run again. OUT
then holds paths.json and paths.png. Paths are those of the disc's centre and of the Panda's last link; a detour is the
path over the shortest way there is, straight to where the goal counts as reached. Clearances are between surfaces,
after every control.

MPC with hard constraints stands for the paper's ForcesPro (``studies/constrained``): CasADi and IPOPT keep spheres of
the robot, one that encloses each link or up to three that cover it, out of the obstacles; ``--casadi PYTHON`` with a
Python that has the package ``casadi``. Fabrics are those of the PyPI package ``fabrics`` 0.10, with its own geometries
and gains, on the same tasks and plants. It needs NumPy below 2, hence another environment, which has casadi, too:
``python -m venv ~/fabrics; ~/fabrics/bin/pip install fabrics==0.10.0``. Runs of either are kept in OUT/fabrics.jsonl.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from shared.files import write_json
from shared.machine import machine
from shared.progress import Bar

import warpmpc
from studies.paper.fabrics.episodes import episode
from studies.paper.runs import make_runs, plan_runs
from studies.paper.tables import TABLES, Cell
from warpmpc.cli.setup import start_warp
from warpmpc.loop.run.workers import FORMS, FinishedJobs, open_workers, scene_digest
from warpmpc.scene.origin import code_digest

ROBOTS = {"point": "point robot", "panda": "Panda"}
METHODS = {"": "ours", "paper": "as in the paper", "ilqg": "iLQG"}
METHODS |= {"enclosing": "constraints, a sphere a link", "covering": "constraints, more spheres", "fabrics": "fabrics"}
"""Second part of a cell's name → method."""
OTHERS = tuple(
    Cell(name=f"{name}_{method}", title=f"{robot}, {METHODS[method]}", scenes=(f"{name}_reach",))
    for method in ("enclosing", "covering", "fabrics")
    for name, robot in ROBOTS.items()
)
"""Rows of methods that run in another environment."""
QUANTITIES = {"path_m": "path length [m]", "clearance_m": "least clearance [m]"}
"""Keys of a row that the picture shows, with their labels."""


def read(cell: Cell, records: list[dict]) -> dict:
    """A cell's runs as lists: time to the goal, path, detour and clearance of those that reached it."""
    robot, _, method = cell.name.partition("_")
    reached = [record for record in records if record["result"]["success"]]
    near = warpmpc.load_scene(cell.scenes[0]).success.distance
    path = [record["measured"]["path_length_m"] for record in reached]
    straight = [record["measured"]["start_position_error_m"] - near for record in reached]
    return {
        "robot": ROBOTS[robot],
        "method": METHODS[method],
        "runs": len(records),
        "touched": sum(bool(record["result"]["collisions"]["max_force_N"]) for record in records),
        "time_s": [record["result"]["time_to_goal_s"] for record in reached],
        "path_m": path,
        "detour": [p / s for p, s in zip(path, straight, strict=True)],
        "clearance_m": [record["measured"]["clearance_m"] for record in reached],
        "plan_ms": [record["result"]["plan_ms"]["p50"] for record in records],
    }


def others(cell: Cell, seeds: range, python: str, records: FinishedJobs, jobs: str) -> list[dict]:
    """Records of a cell's runs by another method, those that are missing made first."""
    (scene,), method = cell.scenes, cell.name.partition("_")[2]
    digest = scene_digest(warpmpc.load_scene(scene))
    keys = {seed: json.dumps((method, scene, seed, digest)) for seed in seeds}
    workers, _ = open_workers(jobs, prepare=start_warp)
    with workers:
        missing = [seed for seed in seeds if keys[seed] not in records.by_key]
        futures = {seed: workers.submit(episode, python, scene, seed, method) for seed in missing}
        for seed, future in futures.items():
            records.add(keys[seed], future.result())
    return [records.by_key[key] for key in keys.values()]


def figures(rows: list[dict], here: dict, command: str) -> dict:
    """The table of the documentation: a column for each method, means of the runs that reached the goal.

    Args:
        rows: As :func:`read` returns them.
        here: ``cores`` and ``cpu`` of the machine that ran our methods.
        command: The command.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    by = {(row["robot"], row["method"]): row for row in rows}
    lines = [
        [title or robot, *(told(by[robot, method]) if (robot, method) in by else "-" for method in methods)]
        for robot in dict.fromkeys(row["robot"] for row in rows)
        for title, told in LINES.items()
    ]
    where = f"{here['cores']} cores of {here['cpu']}"
    made = {"machine": where, "date": time.strftime("%Y-%m-%d"), "command": command, "rows": lines}
    return {"columns": ["", *methods], "groups": [made]}


def _mean(key: str) -> Callable[[dict], str]:
    return lambda row: f"{np.mean(row[key]):.3g}" if row[key] else "-"


def _reached(row: dict) -> str:
    touched = f" ({row['touched']} touched)" if row["touched"] else ""
    return f"{len(row['path_m'])}/{row['runs']}{touched}"


LINES = {
    "": _reached,
    "time [s]": _mean("time_s"),
    "path [m]": _mean("path_m"),
    "detour": _mean("detour"),
    "clearance [m]": _mean("clearance_m"),
    "plan [ms]": lambda row: f"{np.median(row['plan_ms']):.3g}",
}
"""Lines of the table for each robot; the first has its name, and how many runs reached the goal."""


def picture(rows: list[dict], path: Path) -> None:
    """Every run as a dot, with a box for each method; a column for each robot."""
    from matplotlib.figure import Figure

    robots = list(dict.fromkeys(row["robot"] for row in rows))
    figure = Figure(figsize=(3.6 * len(robots), 5.0), layout="constrained")
    panels = figure.subplots(len(QUANTITIES), len(robots), squeeze=False)
    rng = np.random.default_rng(0)
    for column, robot in zip(panels.T, robots, strict=True):
        own = [row for row in rows if row["robot"] == robot and row["path_m"]]
        names = [f"{row['method']}\n{len(row['path_m'])} of {row['runs']}" for row in own]
        for axes, (key, label) in zip(column, QUANTITIES.items(), strict=True):
            axes.boxplot([row[key] for row in own], tick_labels=names, showfliers=False)
            for i, row in enumerate(own):
                x = i + 1 + rng.uniform(-0.12, 0.12, len(row[key]))
                axes.plot(x, row[key], ".", markersize=4, alpha=0.5)
            axes.set_ylabel(label)
            values = [value for row in own for value in row[key]]
            axes.set_ylim(1.05 * min(0.0, *values), 1.08 * max(0.1, *values))
            axes.tick_params(labelsize=8)
            axes.grid(alpha=0.3, axis="y")
        column[0].set_title(robot)
    figure.savefig(path, dpi=110)


def main(arguments: list[str]) -> None:
    """Make the runs that are missing, tell, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10, help="seeds of a cell (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--engine", default="fused", help="engine of the rollouts (default fused)")
    parser.add_argument("--device", default="cpu", help="device of the rollouts (default cpu)")
    parser.add_argument("--fabrics", metavar="PYTHON", help="Python that has the package fabrics: a row more each")
    parser.add_argument("--casadi", metavar="PYTHON", help="Python that has the package casadi: two rows more each")
    parser.add_argument("--others", type=int, metavar="N", help="seeds of those two; as many as --runs when left out")
    parser.add_argument("--out", type=Path, default=Path("build/results"), help="folder of the results")
    parser.add_argument("--docs", type=Path, help="folder of pages that get data/paths.json and paths.png, too")
    args = parser.parse_args(arguments)
    cells = sorted(TABLES["table1"].cells, key=lambda cell: list(ROBOTS).index(cell.name.partition("_")[0]))
    seeds = range(args.seed, args.seed + args.runs)
    runs = plan_runs("table1", cells, seeds=seeds, overrides=[], engine=args.engine, device=args.device)
    records, here = FinishedJobs(args.out / "table1.jsonl"), machine()
    with Bar(sum(run.key not in records.by_key for run in runs)) as bar:
        make_runs(
            runs,
            records,
            jobs=args.jobs,
            device=args.device,
            circumstances={"code": code_digest(), "cpu": here["cpu"], "cores": here["cores"]},
            on_done=lambda run, _: bar.step(f"{run.cell} seed {run.job.seed}"),
        )
    rows = [read(cell, [records.by_key[run.key] for run in runs if run.cell == cell.name]) for cell in cells]
    kept = FinishedJobs(args.out / "fabrics.jsonl")
    for cell in OTHERS:
        if python := args.fabrics if cell.name.endswith("fabrics") else args.casadi:
            rows.append(read(cell, others(cell, seeds[: args.others], python, kept, args.jobs)))
    rows.sort(key=lambda row: [*ROBOTS.values()].index(row["robot"]))
    few = f" --others {args.others}" * bool(args.others)
    command = f"python tools/study.py paths --runs {args.runs} --seed {args.seed} --jobs {args.jobs}"
    command += " --casadi PYTHON" * bool(args.casadi) + " --fabrics PYTHON" * bool(args.fabrics) + few
    table = figures(rows, records.by_key[runs[0].key], command)
    for line in (table["columns"], *table["groups"][0]["rows"]):
        print(" | ".join(line))
    write_json(args.out / "paths.json", {"machine": here, "rows": rows})
    picture(rows, args.out / "paths.png")
    if args.docs:
        write_json(args.docs / "data" / "paths.json", table)
        picture(rows, args.docs / "paths.png")
