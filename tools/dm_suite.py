#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Play the DeepMind Control Suite: its environments, its physics, its rewards; planned by warpmpc, nothing trained.

    python tools/dm_suite.py                                            # all tasks, seeds 0 to 2
    python tools/dm_suite.py walker_run hopper_hop --seeds 100 101 --steps 300 --set planner.samples=128
    python tools/dm_suite.py --jobs 8 --json build/dm_suite.json

An environment comes from the PyPI package dm-control (pip install "warpmpc[bench]") and draws its start from the seed.
warpmpc sees positions, velocities and activations, and where a target is; it plans in the environment's own model
(dm_tasks/*.toml) for costs of its own (dm_tasks/terms.py), and sends actions. The return is the sum of the suite's
rewards, 1000 at most.

Standard output has a table in Markdown, beside the returns of a learned agent. Plan times are honest on an idle machine
alone, with one job. Exit codes: 0 when all episodes were played, 1 when an episode's process died every
time, 2 for bad input, 130 for Ctrl-C.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import as_completed
from pathlib import Path
from typing import TYPE_CHECKING

from warpmpc.run.workers import LostJob, check_jobs, open_workers

if TYPE_CHECKING:
    from dm_tasks.play import Episode

STEPS = 1000
"""Control steps of the suite's episodes."""
LEAST_STEPS = 10
"""The first two plans are not timed."""


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="DOMAIN_TASK", help="all there are scenes for when left out")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], metavar="N", help="default: 0 1 2")
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
    args = parser.parse_args(arguments)
    if not LEAST_STEPS <= args.steps <= STEPS:
        parser.error(f"--steps must be {LEAST_STEPS} to {STEPS}")
    if args.jobs == "gpus":
        parser.error("--jobs gpus: these episodes plan on the CPU; take a number of processes, or ray")
    return args


def episodes(args: argparse.Namespace) -> list[Episode]:
    """What is to be played, everything checked that can be before any process starts.

    Raises:
        ValueError: If there is no such task or engine, or a scene does not take an override.
    """
    from dm_tasks.play import Episode, names, scene_of
    from jobs import check_engine

    check_jobs(args.jobs)
    check_engine(args.engine)
    tasks = list(dict.fromkeys(args.tasks or names()))
    for task in tasks:
        scene_of(task, tuple(args.overrides))
    threads = ("engine.threads=1",) if args.jobs != "1" else ()
    overrides = (*threads, *args.overrides)
    return [
        Episode(name=task, seed=seed, steps=args.steps, engine=args.engine, overrides=overrides)
        for task in tasks
        for seed in args.seeds
    ]


def run(args: argparse.Namespace) -> None:
    """Play all episodes and print the table.

    Raises:
        ValueError: As :func:`episodes`.
    """
    from dm_tasks.play import play
    from dm_tasks.table import table
    from progress import Bar

    from warpmpc.cli.run import start_warp

    wanted = episodes(args)
    played: list[dict] = []
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    with workers, Bar(len(wanted)) as bar:
        futures = {workers.submit(play, episode): episode for episode in wanted}
        for future in as_completed(futures):
            played.append(future.result())
            bar.step(f"{futures[future].name}, seed {futures[future].seed}: {played[-1]['reward']:.0f}")
            if args.json:
                args.json.parent.mkdir(parents=True, exist_ok=True)
                args.json.write_text(json.dumps(played, indent=1) + "\n")
    print(table(played))


def main(arguments: list[str] | None = None) -> int:
    """Command line of this tool; returns the exit code."""
    try:
        run(parse(arguments))
    except LostJob as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
