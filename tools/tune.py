#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
r"""Tune keys of scenes over seeds with Optuna.

    python tools/tune.py omni_push_box:A omni_push_box:B --trials 60 --jobs 2 --study box.db \
        --key cost.yaw.weight=0.5..6:log --key planner.knots=3..8 --key 'planner.noise.sigma[0]=0.1..1' \
        --key 'planner.spline=linear|cubic'

Keys are those of --set. Ranges are real, or whole where both ends are written whole; :log searches by order of
magnitude; a|b|c is a choice. --key also takes a file of such lines. Several scenes are tuned together.

A trial is judged by the mean over all scenes and seeds of the time to the goal; failures cost at least twice the
timeout and the more the farther they end from the goal. The first trial is the scenes as they are. The study is a
file: the same command goes on where it was interrupted, with more --trials it goes on further. One process at a time
may use a study. Exit codes: 0 when all trials were made, 1 when an episode's process died every
time, 2 for bad input, 130 for Ctrl-C.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from warpmpc.run.workers import FORMS, LostJob, check_jobs, open_workers

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial
    from tuning.search import Task

FIRST_SEED = 10000
"""Seeds used for tuning are never the seeds reported: those start at 0."""


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE[:VARIANT]")
    parser.add_argument(
        "--key", "--keys", dest="keys", nargs="+", action="extend", default=[], metavar="KEY=SPEC", help="or a file"
    )
    parser.add_argument("--trials", type=int, default=50, help="trials the study shall hold (default 50)")
    parser.add_argument("--episodes", type=int, default=4, help="seeds per scene (default 4)")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help=f"first seed (default {FIRST_SEED})")
    parser.add_argument(
        "--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1); several trials at a time take a thread each"
    )
    parser.add_argument("--study", type=Path, default=Path("build/tune.db"), help="SQLite file (default build/tune.db)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--engine", default="auto", help="engine of the rollouts")
    parser.add_argument("--device", default="auto", help="device of the rollouts")
    parser.add_argument(
        "--contact-penalty", type=float, default=5.0, metavar="SECONDS", help="price of a hard contact (default 5)"
    )
    args = parser.parse_args(arguments)
    if not args.keys:
        parser.error("nothing to tune: give --key KEY=SPEC")
    for name in ("trials", "episodes"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1")
    return args


def tune(args: argparse.Namespace) -> None:
    """Run or go on with a study, then print what it found.

    Raises:
        ValueError: If a scene, a key or the study does not fit.
    """
    from jobs import check_engine
    from progress import Bar
    from tuning.search import Task, done, open_study, search
    from tuning.space import parse_space, start_values

    from warpmpc import load_scene
    from warpmpc.cli.setup import start_warp

    check_jobs(args.jobs)
    check_engine(args.engine)
    space = parse_space(args.keys)
    scenes = {source: load_scene(source, overrides=args.overrides) for source in args.scenes}
    for source, scene in scenes.items():
        if scene.success is None:
            raise ValueError(f"{source}: [success] is missing: a trial is judged by the time to it")
    task = Task(
        scenes=scenes,
        space=space,
        start=start_values(space, scenes, args.overrides),
        seeds=list(range(args.seed, args.seed + args.episodes)),
        overrides=args.overrides,
        engine=args.engine,
        device=args.device,
        contact_penalty=args.contact_penalty,
    )
    study = open_study(args.study, task)
    try:
        workers, device = open_workers(args.jobs, device=args.device, prepare=start_warp)
        with workers, Bar(max(args.trials - len(done(study)), 0)) as bar:

            def on_trial(trial: FrozenTrial) -> None:
                bar.say(describe(trial, task))
                bar.step(f"trial {trial.number}")

            search(study, replace(task, device=device), workers, trials=args.trials, on_trial=on_trial)
    finally:
        report(study, task)


def describe(trial: FrozenTrial, task: Task) -> str:
    """One line about a trial."""
    if refused := trial.user_attrs.get("refused"):
        return f"trial {trial.number}: refused: {refused}"
    scores = trial.user_attrs["scores"]
    average, total = sum(scores) / len(scores), len(task.episodes)
    cut = f", pruned after {len(scores)} of {total} episodes" if len(scores) < total else ""
    return f"trial {trial.number}: {average:.2f} s, {trial.user_attrs['reached']} of {len(scores)} reached{cut}"


def report(study: optuna.Study, task: Task) -> None:
    """Print the best values beside the scenes' own, as ``--set`` and as TOML."""
    from tuning.search import START

    complete = [trial for trial in study.trials if trial.value is not None and trial.state.name == "COMPLETE"]
    first = next((trial for trial in complete if START in trial.user_attrs), None)
    if not complete:
        return
    best = min(complete, key=lambda trial: trial.value)
    values = {p.key: float(f"{v:.6g}") if isinstance(v := best.params[p.key], float) else v for p in task.space}
    if first:
        print(f"start  {describe(first, task)}")
    print(f"best   {describe(best, task)}")
    if best is first:
        print("no trial was better than the values the scenes have")
    print(f"tuned on {', '.join(task.scenes)} with seeds {task.seeds[0]} to {task.seeds[-1]}: report other seeds\n")
    for change in task.changes(values):
        print(f"--set {shlex.quote(change)}")
    print("\n[variants.tuned]")
    for parameter in task.space:
        print(f"{parameter.key} = {parameter.text(values[parameter.key])}")


def main(arguments: list[str] | None = None) -> int:
    """Command line of this tool; returns the exit code."""
    try:
        tune(parse(arguments))
    except LostJob as error:
        print(f"error: {error}; the same command goes on", file=sys.stderr)
        return 1
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
