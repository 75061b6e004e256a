# SPDX-License-Identifier: Apache-2.0
"""Repeat the experiments of the paper's tables and compare.

    python tools/study.py reproduce table4 --jobs 2               # all cells, as many runs as the paper
    python tools/study.py reproduce papers --jobs 2               # every row of the three papers
    python tools/study.py reproduce table1/point --runs 20        # one cell
    python tools/study.py reproduce table4 --set planner.samples=300 --out build/samples300
    python tools/study.py reproduce sampling --json build         # build/sampling.json, as docs/data has it
    python tools/study.py reproduce table1 --jobs gpus            # a process for each GPU of this machine
    python tools/study.py reproduce table4 --jobs ray             # the Ray cluster that this machine belongs to

Every finished run is added to OUT/TABLE.jsonl and never repeated while scene, overrides, seed, engine and device are
the same: run the same command again to go on after an interruption. OUT then holds TABLE.md and TABLE.json.
"""

from __future__ import annotations

import argparse
import difflib
import json
import shlex
import sys
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from studies.paper.tables import GROUPS, TABLES, Cell
from warpmpc.loop.run.workers import FORMS, check_jobs

if TYPE_CHECKING:
    from studies.paper.report import Report


def chosen(names: list[str]) -> dict[str, list[Cell]]:
    """Tables and their cells from ``TABLE``, ``TABLE/CELL`` and names of groups.

    Raises:
        ValueError: If there is no such table or cell.
    """
    out: dict[str, list[Cell]] = {}
    for wanted in (name for given in names for name in GROUPS.get(given, (given,))):
        table, _, cell = wanted.partition("/")
        _known("table", table, [*TABLES, *GROUPS])
        cells = TABLES[table].cells
        if cell:
            _known(f"cell of {table}", cell, [c.name for c in cells])
        have = out.setdefault(table, [])
        have += [c for c in cells if cell in ("", c.name) and c not in have]
    return out


def _known(what: str, name: str, names: list[str]) -> None:
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1)
        hint = f". Did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"no such {what}: {name!r}; there is: {', '.join(names)}{hint}")


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tables = "\n".join(f"  {name:13} {', '.join(cell.name for cell in t.cells)}" for name, t in TABLES.items())
    groups = "\n".join(f"  {name:13} {', '.join(tables)}" for name, tables in GROUPS.items())
    parser.epilog = f"tables and their cells:\n{tables}\ntables together:\n{groups}"
    parser.add_argument("tables", nargs="+", metavar="TABLE[/CELL]")
    parser.add_argument("--runs", type=int, help="seeds per scene; as many as in the paper by default")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--engine", default="auto", help="engine of the rollouts")
    parser.add_argument("--device", default="auto", help="device of the rollouts")
    parser.add_argument(
        "--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1); several runs at a time take a thread each"
    )
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--out", type=Path, default=Path("build/results"), help="folder of the results (default build/results)"
    )
    parser.add_argument("--json", type=Path, metavar="FOLDER", help="write FOLDER/TABLE.json, as docs/data has them")
    args = parser.parse_args(arguments)
    if args.json and args.json.resolve() == args.out.resolve():
        parser.error("--json: another folder than --out, whose reports have the same names")
    if args.runs is not None and args.runs < 1:
        parser.error("--runs must be at least 1")
    if args.seed < 0:
        parser.error("--seed must not be below 0")
    return args


def reproduce(args: argparse.Namespace, arguments: list[str]) -> None:
    """Plan all runs of all tables, make those that are missing, and report.

    Raises:
        ValueError: If a table, a scene, an override, the engine or the device is wrong.
    """
    selection = chosen(args.tables)  # a mistyped name need not wait for imports
    from shared.files import put_rows
    from shared.jobs import check_engine
    from shared.machine import machine
    from shared.progress import Bar

    from studies.paper.report import Report, Row
    from studies.paper.runs import Run, make_runs, plan_runs
    from warpmpc.loop.run.workers import FinishedJobs
    from warpmpc.scene.origin import code_digest

    check_jobs(args.jobs)
    check_engine(args.engine)
    plans = {}
    for name, cells in selection.items():
        seeds = range(args.seed, args.seed + (args.runs or TABLES[name].runs))
        options = {"overrides": args.overrides, "engine": args.engine, "device": args.device}
        plans[name] = plan_runs(name, cells, seeds=seeds, **options)
    kept = {name: FinishedJobs(args.out / f"{name}.jsonl") for name in plans}
    here = machine()
    circumstances = {"code": code_digest(), "cpu": here["cpu"], "cores": here["cores"]}
    try:
        with Bar(sum(run.key not in kept[name].by_key for name, runs in plans.items() for run in runs)) as bar:

            def on_done(run: Run, record: dict) -> None:
                if not record["result"]["success"]:
                    bar.say(f"{run.table}/{run.cell} seed {run.job.seed}: {record['result']['reason']}")
                bar.step(f"{run.cell} seed {run.job.seed}")

            for name, runs in plans.items():
                make_runs(
                    runs,
                    kept[name],
                    jobs=args.jobs,
                    device=args.device,
                    circumstances=circumstances,
                    on_done=on_done,
                )
    finally:
        for name, runs in plans.items():
            made = [(run, kept[name].by_key[run.key]) for run in runs if run.key in kept[name].by_key]
            rows = [Row(cell, [item for item in made if item[0].cell == cell.name]) for cell in selection[name]]
            if made:
                today = date.today().isoformat()
                command = shlex.join(["python", "tools/study.py", "reproduce", *arguments])
                report = Report(name, TABLES[name], rows, command, here, today, circumstances["code"])
                publish(report, args.out)
                if args.json:
                    path = args.json / f"{name}.json"
                    put_rows(path, *report.figures(), study="reproduce", arguments=arguments)


def publish(report: Report, folder: Path) -> None:
    """Write a table's page and data to a folder, and print it."""
    from rich.console import Console

    (folder / f"{report.name}.md").write_text(report.markdown(), encoding="utf-8")
    data = json.dumps(report.to_json(), indent=2, ensure_ascii=False)
    (folder / f"{report.name}.json").write_text(data + "\n", encoding="utf-8")
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(report.grid())
    for line in report.failure_lines():
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def main(arguments: list[str]) -> None:
    """Command line of this study."""
    reproduce(parse(arguments), arguments)
