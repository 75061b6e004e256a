# SPDX-License-Identifier: Apache-2.0
"""Play the DeepMind Control Suite: its environments, its physics, its rewards; planned by warpmpc, nothing trained.

    python tools/study.py dm_suite                                            # all tasks, seeds 0 to 2
    python tools/study.py dm_suite walker_run hopper_hop --seeds 100 101 --steps 300 --set planner.samples=128
    python tools/study.py dm_suite --report NAME --jobs 16 --engine fused --json build/dm_suite.json
    python tools/study.py dm_suite --table build/dm_suite.json more.json      # plays nothing

An environment comes from the PyPI package dm-control (pip install "warpmpc[bench]") and draws its start from the seed.
warpmpc sees positions, velocities and activations, and where a target is; it plans in the environment's own model
(*.toml beside this file) for its own costs (terms.py), and sends actions. The return is the sum of the suite's
rewards, 1000 at most.

Seeds 0 to 999 are for tuning. --report draws ten that nobody has looked at and notes them in seeds.toml first; the same
command again goes on with them. Episodes that FILE of --json has already, with the same settings, are not played again.

Standard output has a table in Markdown, beside the returns of a learned agent. Plan times are honest on an idle machine
alone, with one job.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING

from shared.files import write_json
from shared.seeds import draw, worn

from warpmpc.loop.run.workers import check_jobs, open_workers

if TYPE_CHECKING:
    from studies.suite.play import Episode

STEPS = 1000
"""Control steps of the suite's episodes."""
LEAST_STEPS = 10
"""The first two plans are not timed."""


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="DOMAIN_TASK", help="all there are scenes for when left out")
    parser.add_argument("--seeds", type=int, nargs="+", metavar="N", help="default: 0 1 2")
    parser.add_argument("--report", metavar="NAME", help="play seeds that nobody has looked at and note whose they are")
    parser.add_argument("--steps", type=int, default=STEPS, help="shorter episodes, for trying things out")
    parser.add_argument("--engine", default="auto", help="engine of the rollouts")
    parser.add_argument(
        "--jobs",
        default="1",
        metavar="WHERE",
        help="a number of processes, ray or ray:HOST:PORT (default 1); several episodes at a time take a thread each",
    )
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--json", type=Path, metavar="FILE", help="every episode, written as soon as it was played")
    parser.add_argument("--table", type=Path, nargs="+", metavar="FILE", help="the table of such files; plays nothing")
    args = parser.parse_args(arguments)
    if not LEAST_STEPS <= args.steps <= STEPS:
        parser.error(f"--steps must be {LEAST_STEPS} to {STEPS}")
    if args.jobs == "gpus":
        parser.error("--jobs gpus: these episodes plan on the CPU; take a number of processes, or ray")
    if args.report and (args.seeds or args.steps != STEPS):
        parser.error(f"--report draws its own seeds and plays {STEPS} steps: leave out --seeds and --steps")
    return args


def episodes(args: argparse.Namespace) -> list[Episode]:
    """What is to be played, in this order, everything checked that can be before any process starts.

    One episode of each task comes first: it compiles the kernel, and tells what is wrong. Among these and among the
    others the longest come first, so that several processes end together.

    Raises:
        ValueError: If there is no such task or engine, a scene does not take an override, or the report was made with
            other settings.
    """
    from shared.jobs import check_engine

    from studies.suite.play import Episode, names, scene_of, settings_of, work

    check_jobs(args.jobs)
    check_engine(args.engine)
    overrides = tuple(args.overrides)
    tasks = {name: work(name, scene_of(name, overrides)) for name in args.tasks or names()}
    settings = {name: settings_of([name], overrides, args.engine) for name in tasks}
    if args.report:
        seeds = draw(args.report, settings_of(names(), overrides, args.engine))
        print(f"seeds {seeds[0]} to {seeds[-1]}, drawn for '{args.report}'", file=sys.stderr)
    else:
        seeds = list(dict.fromkeys(args.seeds or [0, 1, 2]))
        if used := worn(seeds):
            print(f"warning: seeds that a report may draw are worn out by this: {used}", file=sys.stderr)
    threads = ("engine.threads=1",) if args.jobs != "1" else ()
    return [
        Episode(
            name=task,
            seed=seed,
            steps=args.steps,
            engine=args.engine,
            overrides=(*threads, *overrides),
            settings=settings[task],
        )
        for some in (seeds[:1], seeds[1:])
        for task in sorted(tasks, key=tasks.get, reverse=True)
        for seed in some
    ]


def run(args: argparse.Namespace) -> None:
    """Play all episodes and print the table.

    Raises:
        ValueError: As :func:`episodes`, or if a file of episodes is none.
        BrokenProcessPool: If a process died; what was played before is kept.
    """
    from shared.progress import Bar

    from studies.suite.play import play
    from studies.suite.table import read, table
    from warpmpc.cli.setup import start_warp

    if args.table:
        print(table(read(args.table)))
        return
    kept = read([args.json]) if args.json and args.json.exists() else []
    done = {_key(row): row for row in kept}
    wanted = {_key(vars(episode) | {"task": episode.name}): episode for episode in episodes(args)}
    left = [episode for key, episode in wanted.items() if key not in done]
    lost = None
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    with workers, Bar(len(left)) as bar:
        futures = {workers.submit(play, episode): episode for episode in left}
        for future in as_completed(futures):
            what = f"{futures[future].name}, seed {futures[future].seed}"
            try:
                played = future.result()
            except BrokenProcessPool as error:
                lost = error
                bar.step(f"{what}: lost")
                continue
            done[_key(played)] = played
            bar.step(f"{what}: {played['reward']:.0f}")
            if args.json:
                write_json(args.json, list(done.values()))
    if rows := [row for key, row in done.items() if key in wanted]:
        print(table(rows))
    if lost:
        raise lost


def _key(row: dict) -> tuple:
    """An episode, as what it was played with tells it."""
    return row["task"], row["seed"], row["steps"], row["settings"]


def main(arguments: list[str]) -> None:
    """Command line of this study."""
    run(parse(arguments))
