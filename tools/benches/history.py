# SPDX-License-Identifier: Apache-2.0
"""Keep ratios of night after night: measure, append a line to a file, plot all of its lines.

    python tools/bench.py history nightly.jsonl --plot nightly.png       # measures as `plans` does
    python tools/bench.py history nightly.jsonl --of plans.json          # what `plans --json` wrote
    python tools/bench.py history nightly.jsonl --plot nightly.png --measure none

A line is one JSON object: date, commit, machine and, by row, how many times as fast as its floor a plan or the physics
was in that run. Times themselves follow the machine; a ratio is of two times of one process. Only lines of the newest
line's machine are plotted, and a row that is slower than the median of the lines before it by more than a fifth is
named; then the exit code is 1.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path

import numpy as np

SLOWER = 0.8
"""Share of the usual ratio below which a row is named: repeated runs on one busy machine differ by a tenth."""


def ratios(report: dict) -> dict[str, float]:
    """Times as fast as the floor, by row, of what ``plans --json`` writes; rows that failed are left out."""
    out = {}
    for row in report["rows"]:
        name = f"{row['title']} on {row['where']}"
        if "ratio" in row:
            out[name] = row["ratio"]
        elif "plan_ms" in row and "floor_ms" in row:
            out[name] = row["floor_ms"]["p50"] / row["plan_ms"]["p50"]
    return out


def entry(report: dict) -> dict:
    """A line of the history.

    Args:
        report: What ``plans --json`` writes.

    Raises:
        ValueError: If no row of it has a floor.
    """
    found = ratios(report)
    if not found:
        raise ValueError("no row was measured beside its floor: run plans without --no-floor")
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    here = report["machine"]
    machine = {key: here[key] for key in ("cpu", "cores", "gpus")}
    return {"date": report["date"], "commit": commit or None, "machine": machine, "times_as_fast": found}


def read(file: Path) -> list[dict]:
    """Lines of a history, none where there is no file.

    Raises:
        ValueError: If a line is none.
    """
    lines = []
    for number, text in enumerate(file.read_text(encoding="utf-8").splitlines() if file.exists() else (), 1):
        try:
            line = json.loads(text)
            lines.append({key: line[key] for key in ("date", "commit", "machine", "times_as_fast")})
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{file}: line {number} is no line of a history ({error}): mend or remove it") from error
    return lines


def slower(lines: list[dict]) -> dict[str, tuple[float, float]]:
    """Rows of the newest line that are slower than they were: ratio now, and usually, on this machine."""
    *earlier, newest = lines
    out = {}
    for name, now in newest["times_as_fast"].items():
        before = [line["times_as_fast"][name] for line in earlier if name in line["times_as_fast"]]
        if before and now < SLOWER * (usual := float(np.median(before))):
            out[name] = (now, usual)
    return out


def plot(lines: list[dict], path: Path) -> None:
    """Draw every row's ratio over the lines."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(name for line in lines for name in line["times_as_fast"]))
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    axes = figure.add_subplot()
    for name in names:
        axes.plot([line["times_as_fast"].get(name, np.nan) for line in lines], marker="o", ms=3.0, lw=1.0, label=name)
    marks = np.unique(np.linspace(0, len(lines) - 1, min(len(lines), 12)).astype(int))
    axes.set_xticks(marks, [f"{lines[i]['date']}\n{lines[i]['commit']}" for i in marks], fontsize=7)
    axes.set(yscale="log", ylabel="times as fast as the floor", title=lines[-1]["machine"]["cpu"])
    axes.legend(fontsize=6, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=120)


def main(arguments: list[str]) -> int:
    """Measure, append, plot, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("history", type=Path, help="file of lines, made if there is none")
    parser.add_argument("--of", type=Path, metavar="FILE", help="what plans --json wrote, rather than measuring")
    parser.add_argument("--measure", choices=("all", "cpu", "gpu", "none"), default="all", help="devices")
    parser.add_argument("--plot", type=Path, metavar="PNG")
    options = parser.parse_args(arguments)
    lines = read(options.history)
    if options.of or options.measure != "none":
        file = options.of or options.history.with_name(f"{options.history.name}.plans")
        if not options.of:
            from . import plans

            plans.main(["--on", options.measure, "--json", str(file)])
        line = entry(json.loads(file.read_text(encoding="utf-8")))
        lines.append(line)
        with options.history.open("a", encoding="utf-8") as into:
            into.write(json.dumps(line, ensure_ascii=False) + "\n")
        if not options.of:
            file.unlink()
    if not lines:
        raise ValueError(f"{options.history}: there are no lines yet: leave --measure none out")
    lines = [line for line in lines if line["machine"] == lines[-1]["machine"]]
    if options.plot:
        plot(lines, options.plot)
    worse = slower(lines)
    for name, (now, usual) in worse.items():
        print(f"slower: {name}: {now:.3g} times its floor, usually {usual:.3g}")
    print(f"{len(lines)} lines of this machine in {options.history}")
    return int(bool(worse))
