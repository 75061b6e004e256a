# SPDX-License-Identifier: Apache-2.0
r"""An arm goes to random reachable poses: how many it reaches, in what time, and the least time there is.

    python tools/study.py storm_reach --poses 100 --jobs 2 --method planner learned osc least
    python tools/study.py storm_reach --poses 20 --ablations --jobs 2

Poses are the tool's in random postures that touch nothing, by MuJoCo's contacts, with 2 cm to spare. A pose is reached
when it has been held for 0.5 s within the scene's tolerances; its time is when that began. Seeds from 10000 on are for
tuning, those reported start at 0. ``learned`` is the scene's variant of that name, ``osc`` operational-space control at
500 Hz, ``least`` the least time that velocity and acceleration limits allow, past any obstacle: pip install ruckig.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path

from shared.files import put_rows

from studies.arms.poses import CLEARANCE
from studies.arms.report import FIGURES, figures, line, summary
from warpmpc.loop.run.workers import FORMS, open_workers

METHODS = {
    "planner": "`{}`",
    "learned": "`{}:learned`: a network for self collision",
    "osc": "OSC, blind to obstacles",
    "least": "least time at the same limits, obstacles ignored",
}
"""Methods, with what tables call them; ``learned`` is the scene's variant."""


@dataclass(frozen=True)
class Cell:
    """One row of a table."""

    name: str
    overrides: tuple[str, ...] = ()
    """Changes of the scene, ``KEY=VALUE``."""
    method: str = "planner"


def _adapted(form: str) -> Cell:
    """STORM's α_σ and κ."""
    keys = {"form": f'"{form}"', "step_size": "0.7", "kappa": "0.005"}
    return Cell(f"covariance {form}", tuple(f"planner.covariance.{key}={value}" for key, value in keys.items()))


TERMS = ("pose", "stop", "manipulability", "joint_bounds", "posture", "self_collision", "world_collision")

ABLATIONS = (
    Cell("as shipped"),
    Cell("without postures", ("planner.postures=false",)),
    *(Cell(f"without {term}", (f"cost.{term}.weight=0.0",)) for term in TERMS),
    *map(_adapted, ("diagonal", "full")),
    Cell("no null particles", ("planner.noise.null_sample=false",)),
    Cell("5 % null particles", ("planner.noise.null_share=0.05",)),
    Cell("the same noise at every plan", ("planner.noise.redraw=false",)),
    *(Cell(f"N = {count}", (f"planner.samples={count}",)) for count in (50, 100, 200, 1000, 5000)),
    *(
        Cell(f"N = {count}, no postures", (f"planner.samples={count}", "planner.postures=false"))
        for count in (50, 5000)
    ),
)
"""The paper's ablations."""


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="storm_reach")
    parser.add_argument("--poses", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--method", nargs="+", choices=METHODS, default=["planner"])
    parser.add_argument("--ablations", action="store_true", help="the planner with one thing changed at a time")
    parser.add_argument("--cell", nargs="+", default=None, help="some of the ablations by name")
    parser.add_argument("--clearance", type=float, default=CLEARANCE, help="of the postures that poses are drawn from")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=None, help="file of all records, one JSON object a line")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table's figures, as docs/data has them")
    return parser.parse_args(arguments)


def measure(args: argparse.Namespace, arguments: list[str]) -> None:
    """Run all poses of all cells and print a line for each cell.

    Raises:
        ValueError: If a scene or a cell does not exist, or a method's packages are missing.
    """
    from studies.arms.runs import run_pose
    from warpmpc.cli.setup import start_warp

    cells = [Cell(METHODS[name].format(args.scene), method=name) for name in args.method]
    if args.ablations:
        cells = [cell for cell in ABLATIONS if args.cell is None or cell.name in args.cell]
    seeds, rows = range(args.seed, args.seed + args.poses), []
    print(line())
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    with workers:
        for cell in cells:
            overrides = ("engine.threads=1", *cell.overrides, *args.overrides)
            scene = f"{args.scene}:learned" if cell.method == "learned" else args.scene
            jobs = [workers.submit(run_pose, cell.method, scene, overrides, seed, args.clearance) for seed in seeds]
            records = sorted((job.result() for job in as_completed(jobs)), key=lambda record: record["seed"])
            if args.out:
                with open(args.out, "a", encoding="utf-8") as file:
                    file.writelines(json.dumps({"cell": cell.name, **record}) + "\n" for record in records)
            print(summary(cell.name, records), flush=True)
            rows.append(figures(cell.name, records))
    if args.json:
        put_rows(args.json, FIGURES, rows, study="storm_reach", arguments=arguments)


def main(arguments: list[str]) -> None:
    """Command line of this study."""
    measure(parse(arguments), arguments)
