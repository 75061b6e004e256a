# SPDX-License-Identifier: Apache-2.0
"""Success of every form of covariance over the number of samples, with and without contact.

    python tools/study.py covariance --jobs 16                     # 4 scenes, 5 forms, 50 to 1000 samples, 5 seeds
    python tools/study.py covariance --scenes holonomic_2d --samples 50 500 --runs 1
    python tools/study.py covariance --draw docs/data/covariance.json --out docs    # docs/covariance.png, no runs

STORM says that adapting it saves samples, Pezzato et al. that it makes an arm stagnate in contact. Posture proposals
are off. Adapted forms have STORM's α_σ = 0.7, and κ is the variance at the start, as in its code; ``FORM-shrinking``
has κ = 0, so that nothing widens what has narrowed but ``planner.sigma_min``. Finished runs are kept in
OUT/covariance.jsonl and never repeated; the same command goes on after an interruption. OUT then holds covariance.json
and covariance.png.
"""

from __future__ import annotations

import argparse
import json
import shlex
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from shared.files import write_json
from shared.intervals import rate
from shared.machine import machine
from shared.progress import Bar

import warpmpc
from studies.paper.runs import make_runs, plan_runs
from studies.paper.tables import Cell
from warpmpc.loop.run.workers import FORMS, FinishedJobs
from warpmpc.scene.origin import code_digest
from warpmpc.scene.schema import CovarianceForm

if TYPE_CHECKING:
    from collections.abc import Sequence

SCENES = ("storm_reach", "holonomic_2d", "panda_push_objects:A_centre", "mobile_pick")
DRAWS = {
    "storm_reach": (
        'randomize_task.draw={"goal.position"={low=[0.35, -0.4, 0.25], high=[0.6, 0.4, 0.6]}}',
        'randomize_task.reject=[{place="goal", clearance=0.12}]',
    )
}
"""Goals of a scene that has but one, so that seeds differ by more than their noise."""
SAMPLES = (50, 100, 200, 500, 1000)
SHRINKING = "-shrinking"
VARIANTS = (*CovarianceForm, f"{CovarianceForm.DIAGONAL}{SHRINKING}")


def cells(scenes: Sequence[str], forms: Sequence[str], samples: Sequence[int]) -> list[Cell]:
    """Every scene with every form and number of samples; names are ``SCENE/FORM/N``."""
    found = []
    for scene in scenes:
        planner = warpmpc.load_scene(scene).planner
        sigma = planner.noise.sigma
        own = (*DRAWS.get(scene, ()), *(("planner.postures=false",) if planner.postures else ()))
        for name in forms:
            form = name.removesuffix(SHRINKING)
            kappa = [0.0] if name.endswith(SHRINKING) else [round(value**2, 6) for value in sigma]
            adapted = "" if form == CovarianceForm.FIXED else f", step_size=0.7, kappa={kappa}"
            for count in samples:
                changes = (f'planner.covariance={{form="{form}"{adapted}}}', f"planner.samples={count}")
                cell = f"{scene}/{name}/{count}"
                found.append(Cell(name=cell, title=cell, scenes=(scene,), overrides=(*own, *changes)))
    return found


def figures(points: list[dict], source: dict[str, str]) -> dict:
    """Points of the picture as JSON that tools/pages/figures.py makes a table of: runs that reached, of how many."""
    counts = sorted({point["samples"] for point in points})
    rows: dict[tuple[str, str], dict[int, str]] = {}
    for point in points:
        reached = f"{round(point['rate'] * point['runs'])}/{point['runs']}"
        rows.setdefault((point["scene"], point["form"]), {})[point["samples"]] = reached
    table = [[f"`{scene}`", form, *(row.get(n, "–") for n in counts)] for (scene, form), row in rows.items()]
    group = {"rows": table, **source}
    return {"columns": ["scene", "form", *map(str, counts)], "groups": [group], "points": points}


def picture(rows: list[dict], path: Path) -> None:
    """Success, and the median time of runs that reach the goal, over the number of samples: a panel for each scene."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    forms = list(dict.fromkeys(row["form"] for row in rows))
    figure = Figure(figsize=(3.6 * len(scenes), 5.6), layout="constrained")
    for column, scene in zip(figure.subplots(2, len(scenes), squeeze=False, sharex=True).T, scenes, strict=True):
        own = [row for row in rows if row["scene"] == scene]
        for i, form in enumerate(forms):
            some = [row for row in own if row["form"] == form]
            x = np.array([row["samples"] for row in some]) * 1.03 ** (i - 0.5 * (len(forms) - 1))  # bars side by side
            y, low, high = (np.array([row[key] for row in some]) for key in ("rate", "low", "high"))
            look = {"label": form, "color": f"C{i}", "marker": "o", "markersize": 4}
            column[0].errorbar(x, 100 * y, 100 * np.array([y - low, high - y]), capsize=2, **look)
            column[1].plot(x, np.array([row["time_s"] for row in some], dtype=float), **look)
        column[0].set(title=scene, xscale="log", ylim=(-3, 103))
        column[1].set(xlabel="samples")
        column[1].axhline(0.0, linewidth=0.0)  # times begin at zero
        column[1].set_xticks(sorted({row["samples"] for row in own}), sorted({row["samples"] for row in own}))
        for axes in column:
            axes.minorticks_off()
            axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("reached [%]")
    figure.axes[len(scenes)].set_ylabel("time to goal, median [s]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(forms))
    figure.savefig(path, dpi=120)


def main(arguments: list[str]) -> None:
    """Make the runs that are missing, tell, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--forms", nargs="+", default=VARIANTS, choices=VARIANTS, metavar="FORM")
    parser.add_argument("--samples", nargs="+", type=int, default=SAMPLES)
    parser.add_argument("--runs", type=int, default=5, help="seeds of a cell (default 5)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=Path("build/covariance"), help="folder of the results")
    parser.add_argument("--draw", type=Path, metavar="JSON", help="only draw the picture of an earlier covariance.json")
    args = parser.parse_args(arguments)
    if args.draw:
        picture(json.loads(args.draw.read_text())["points"], args.out / "covariance.png")
        return
    seeds = range(args.seed, args.seed + args.runs)
    wanted = cells(args.scenes, args.forms, args.samples)
    overrides = ["engine.threads=1", *args.overrides]
    runs = plan_runs("covariance", wanted, seeds=seeds, overrides=overrides, engine="auto", device="cpu")
    records, here = FinishedJobs(args.out / "covariance.jsonl"), machine()
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
    command = shlex.join(["python", "tools/study.py", "covariance", *arguments])
    source = {"machine": f"{here['cores']} cores", "date": f"{date.today()}", "command": command}
    write_json(args.out / "covariance.json", figures(rows, source) | {"on": here})
    picture(rows, args.out / "covariance.png")
