# SPDX-License-Identifier: Apache-2.0
"""Success of every form of covariance over the number of samples: does adapting it save samples, as STORM says?

    python tools/study.py covariance --jobs 16                     # 2 scenes, 5 forms, 50 to 1000 samples, 20 seeds
    python tools/study.py covariance --scenes holonomic_2d --samples 50 500 --runs 1

Posture proposals are off. Adapted forms have the paper's α_σ = 0.7, and κ is the variance at the start, as in its code.
Finished runs are kept in OUT/covariance.jsonl and never repeated; the same command goes on after an interruption. OUT
then holds covariance.json and covariance.png.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from shared.files import write_json
from shared.intervals import rate
from shared.machine import machine
from shared.progress import Bar

import warpmpc
from studies.experiments.runs import make_runs, plan_runs
from studies.experiments.tables import Cell
from warpmpc.origin import code_digest
from warpmpc.run.records import Records
from warpmpc.run.workers import FORMS
from warpmpc.scene.schema import CovarianceForm

if TYPE_CHECKING:
    from collections.abc import Sequence

SCENES = ("storm_reach", "holonomic_2d")
DRAWS = {
    "storm_reach": (
        'randomize_task.draw={"goal.position"={low=[0.35, -0.4, 0.25], high=[0.6, 0.4, 0.6]}}',
        'randomize_task.reject=[{place="goal", clearance=0.12}]',
    )
}
"""Goals of a scene that has but one, so that seeds differ by more than their noise."""
SAMPLES = (50, 100, 200, 500, 1000)


def cells(scenes: Sequence[str], forms: Sequence[str], samples: Sequence[int]) -> list[Cell]:
    """Every scene with every form and number of samples; names are ``SCENE/FORM/N``."""
    found = []
    for scene in scenes:
        planner = warpmpc.load_scene(scene).planner
        kappa = [round(sigma**2, 6) for sigma in planner.noise.sigma]
        own = (*DRAWS.get(scene, ()), *(("planner.postures=false",) if planner.postures else ()))
        for form in forms:
            adapted = "" if form == CovarianceForm.FIXED else f", step_size=0.7, kappa={kappa}"
            for count in samples:
                changes = (f'planner.covariance={{form="{form}"{adapted}}}', f"planner.samples={count}")
                name = f"{scene}/{form}/{count}"
                found.append(Cell(name=name, title=name, scenes=(scene,), overrides=(*own, *changes)))
    return found


def picture(rows: list[dict], path: Path) -> None:
    """Success over the number of samples, a line for each form, a panel for each scene."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(5.0 * len(scenes), 3.6), layout="constrained")
    for axes, scene in zip(np.atleast_1d(figure.subplots(1, len(scenes))), scenes, strict=True):
        own = [row for row in rows if row["scene"] == scene]
        forms = list(dict.fromkeys(row["form"] for row in own))
        for i, form in enumerate(forms):
            some = [row for row in own if row["form"] == form]
            x = np.array([row["samples"] for row in some]) * 1.03 ** (i - 0.5 * (len(forms) - 1))  # bars side by side
            y, low, high = (np.array([row[key] for row in some]) for key in ("rate", "low", "high"))
            axes.errorbar(x, 100 * y, 100 * np.array([y - low, high - y]), label=form, marker="o", capsize=2)
        axes.set(title=scene, xscale="log", xlabel="samples", ylabel="reached [%]", ylim=(-3, 103))
        axes.set_xticks(sorted({row["samples"] for row in own}), sorted({row["samples"] for row in own}))
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    axes.legend(title="covariance.form")
    figure.savefig(path, dpi=150)


def main(arguments: list[str]) -> None:
    """Make the runs that are missing, tell, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--forms", nargs="+", default=[*CovarianceForm], choices=[*CovarianceForm], metavar="FORM")
    parser.add_argument("--samples", nargs="+", type=int, default=SAMPLES)
    parser.add_argument("--runs", type=int, default=20, help="seeds of a cell (default 20)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=Path("build/covariance"), help="folder of the results")
    args = parser.parse_args(arguments)
    seeds = range(args.seed, args.seed + args.runs)
    wanted = cells(args.scenes, args.forms, args.samples)
    overrides = ["engine.threads=1", *args.overrides]
    runs = plan_runs("covariance", wanted, seeds=seeds, overrides=overrides, engine="auto", device="cpu")
    records, here = Records(args.out / "covariance.jsonl"), machine()
    circumstances = {"code": code_digest(), "cpu": here["cpu"], "cores": here["cores"]}
    with Bar(sum(run.key not in records.by_key for run in runs)) as bar:
        make_runs(
            runs,
            records,
            jobs=args.jobs,
            device="cpu",
            circumstances=circumstances,
            on_done=lambda run, _: bar.step(f"{run.cell} seed {run.job.seed}"),
        )
    rows = []
    for cell in wanted:
        results = [records.by_key[run.key]["result"] for run in runs if run.cell == cell.name]
        found, (scene, form, count) = rate(sum(r["success"] for r in results), len(results)), cell.name.split("/")
        times = [r["time_to_goal_s"] for r in results if r["success"]]
        median = float(np.median(times)) if times else None
        row = {"scene": scene, "form": form, "samples": int(count), "rate": found.value, "low": found.low}
        rows.append(row | {"high": found.high, "runs": found.count, "time_s": median})
        span = f"{found.low:.0%} to {found.high:.0%}"
        late = "-" if median is None else f"{median:.2f} s"
        print(f"{cell.name:32s} reached {found.value:4.0%} ({span}) of {found.count}, {late}")
    write_json(args.out / "covariance.json", {"machine": here, "overrides": args.overrides, "rows": rows})
    picture(rows, args.out / "covariance.png")
