# SPDX-License-Identifier: Apache-2.0
"""Bad measurements of every kind to every filter: whether its error comes back, or the safe command.

    python tools/study.py bad_samples --seeds 100:110
    python tools/study.py bad_samples --report "bad measurements" --json docs/data/bad_samples.json

A quadruped trots and a box is waved about, both in as many ways as there are seeds. From what is measured of them the
driver's robot makes states, as in a run, with measurements of a kind made bad from a moment on. A cell has the motions
in which half a second after the last of them the error was below twice what it was before, or the state was too old to
be trusted, and the median time of safe commands [s] where they came. Nothing shows the way and the yaw of a base: they
may be off by 2 cm and 0.01 rad, or by more after a safe command. Lines below the table have the largest errors while
the estimate was trusted.
"""

from __future__ import annotations

import argparse
import logging
import shlex
from datetime import date
from pathlib import Path

import numpy as np
from shared.bad_samples import KINDS, SENSORS, Motion, Outcome, trot, waved
from shared.files import put_group
from shared.machine import machine
from shared.seeds import draw

from studies.others.defaults import code_digest
from studies.plants.estimated import seed_range

FILTERS = {
    "base, unit": (trot, "unit"),
    "base, joints": (trot, "joints"),
    "constant_velocity": (lambda seed: waved("constant_velocity", seed), "pose"),
    "constant_acceleration": (lambda seed: waved("constant_acceleration", seed), "pose"),
}
ERRORS = ("{:.3f} m", "{:.3f} rad", "{:.2f} m/s", "{:.1f} rad/s", "way {:.3f} m", "yaw {:.3f} rad")


def cell(outcomes: list[Outcome]) -> str:
    """What became of an estimate, over all motions."""
    text = f"{sum(outcome.back for outcome in outcomes)}/{len(outcomes)}"
    safe = float(np.median([outcome.safe for outcome in outcomes]))
    return f"{text},{safe:.2f}s" if safe else text


def worst(outcomes: list[Outcome]) -> str:
    """The largest errors while an estimate was trusted."""
    largest = np.max([outcome.worst for outcome in outcomes], axis=0)
    return ", ".join(form.format(value) for form, value in zip(ERRORS, largest, strict=True))


def main(arguments: list[str]) -> int:
    """Run the drills and print the table; returns the exit code: 1 where an error does not come back."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seed_range, default=range(3), metavar="A:B", help="seeds A to B - 1 (0:3)")
    parser.add_argument("--report", metavar="NAME", help="seeds that nobody has looked at, drawn for a report")
    parser.add_argument("--filters", nargs="+", default=list(FILTERS), choices=FILTERS)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS, metavar="KIND")
    parser.add_argument("--json", type=Path, metavar="FILE", help="put the figures there, as docs/data has them")
    args = parser.parse_args(arguments)
    logging.getLogger("warpmpc").setLevel(logging.ERROR)
    seeds = draw(args.report, code_digest()) if args.report else args.seeds
    found: dict[tuple[str, str], list[Outcome]] = {}
    for name in args.filters:
        make, sensor = FILTERS[name]
        for seed in seeds:
            motion: Motion = make(seed)
            good = motion.errors([(measured.time, measured) for measured in motion.measured])
            for kind in args.kinds:
                outcome = motion.drill(KINDS[kind], SENSORS[sensor], good)
                found.setdefault((kind, name), []).append(outcome)
                if not outcome.back:
                    print(f"seed {seed}, {name}, {kind}: does not come back", flush=True)
    about = f"{machine()['cpu']}, {machine()['cores']} cores, seeds {seeds.start} to {seeds.stop - 1}"
    rows = [[kind, *(cell(found[kind, name]) for name in args.filters)] for kind in args.kinds]
    head = ["bad measurements", *args.filters]
    print(about, *(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)), sep="\n")
    print(*(f"{kind}; {name}: {worst(outcomes)}" for (kind, name), outcomes in found.items()), sep="\n")
    if args.json:
        command = shlex.join(["python", "tools/study.py", "bad_samples", *arguments])
        group = {"machine": about, "date": date.today().isoformat(), "command": command, "rows": rows}
        put_group(args.json, head, group)
    return 0 if all(outcome.back for outcomes in found.values() for outcome in outcomes) else 1
