# SPDX-License-Identifier: Apache-2.0
"""Time ``warpmpc run`` from the command to its first line and to the first motion of the plant, in a terminal.

    python tools/bench.py start                                  # three scenes, on the CPU
    python tools/bench.py start omni_push_box quadruped_walk --json start.json

As from a wheel where ``tools/bench.py shipped`` has been run before, else as from a checkout.

Each scene is started four times: with empty caches (the first command on a machine), as a new one where another scene
was run before, again, and with one cost term more. Times are those at which a terminal shows something; caches are
thrown away.
"""

from __future__ import annotations

import argparse
import json
import os
import pty
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table
from shared.files import write_json
from shared.machine import machine

from warpmpc.scene.load import load_scene

OTHERS = Path(__file__).parents[1] / "studies" / "others"
SCENES = ("panda_reach", "quadruped_walk", str(OTHERS / "fetch_push.toml"))
"""A small scene, one of many contacts, and one whose files are another's."""
ANOTHER = "point_reach"
"""Scene that is run before the others where they are new."""
SHOWN = {"compiled": rb"compiling|building \S", "motion": rb"  cost "}
"""Texts by what they tell: something was compiled until the last of the first kind; then the plant has moved."""
CONTROLS = re.compile(rb"\x1b\[[0-9;?]*[a-zA-Z]|[\r\n]")


def start(source: str, cache: Path, options: list[str]) -> dict[str, float]:
    """Run a scene in a terminal up to its first motion; when what is shown, and processor time until then [s].

    Raises:
        RuntimeError: If the run ends before its plant moves.
    """
    folders = {"WARP_CACHE_PATH": str(cache / "warp"), "WARPMPC_CACHE": str(cache / "warpmpc"), "TERM": "xterm"}
    screen, theirs = pty.openpty()
    files, seen, said = {"stdin": subprocess.DEVNULL, "stdout": theirs, "stderr": theirs}, {}, b""
    command = [Path(sys.executable).with_name("warpmpc"), "run", source, *options]
    used, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with subprocess.Popen(command, env=os.environ | folders, **files) as process:
        os.close(theirs)
        while "motion" not in seen:
            try:
                piece = os.read(screen, 65536)
            except OSError:  # it ended
                raise RuntimeError(f"{source}: {said.decode(errors='replace')}") from None
            now, text = time.perf_counter() - began, CONTROLS.sub(b" ", piece)
            said += piece
            if text.strip():
                seen.setdefault("line", now)
            seen |= {what: now for what, shown in SHOWN.items() if re.search(shown, text)}
        process.terminate()
        while True:
            try:
                os.read(screen, 65536)
            except OSError:
                break
    os.close(screen)
    now = resource.getrusage(resource.RUSAGE_CHILDREN)
    return seen | {"processor": now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime}


def with_another_term(source: str) -> list[str]:
    """Options that give a scene a cost term more, which costs next to nothing."""
    cost = [entry.model_dump(mode="json", exclude_unset=True) for entry in load_scene(source).cost]
    return ["--set", f"cost={inline([*cost, {'term': 'control_effort', 'name': 'another', 'weight': 1e-6}])}"]


def inline(value: object) -> str:
    """A value as TOML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {inline(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(inline, value)) + "]"
    return json.dumps(value)


def main(arguments: list[str]) -> None:
    """Start scene after scene, four times each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES, help="scenes (default: three)")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    options, rows = ["--engine", given.engine, "--device", given.device], []
    table = Table(
        "scene", "start", "first line", "compiled", "first motion", "processor time", title="seconds", box=None
    )
    with tempfile.TemporaryDirectory() as folder:
        used = Path(folder) / "used"
        start(ANOTHER, used, options)
        for source in given.scenes:
            empty, new = Path(folder) / "empty", Path(folder) / "new"
            shutil.copytree(used, new)
            starts = (("machine's first", empty), ("new scene", new), ("again", new), ("another term", new))
            for name, cache in starts:
                more = with_another_term(source) if name == "another term" else []
                found = start(source, cache, [*options, *more])
                rows.append({"scene": Path(source).stem, "start": name, "seconds": found})
                cells = [f"{found[part]:.1f}" if part in found else "-" for part in ("line", "compiled", "motion")]
                table.add_row(Path(source).stem, name, *cells, f"{found['processor']:.1f}")
                print(Path(source).stem, name, found, file=sys.stderr, flush=True)
            shutil.rmtree(empty), shutil.rmtree(new)
            if given.json:
                write_json(given.json, {"machine": machine(), "rows": rows})
    Console(width=None if sys.stdout.isatty() else 120).print(table)
