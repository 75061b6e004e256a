# SPDX-License-Identifier: Apache-2.0
"""Time how long scenes take to start, with nothing compiled (cold) and again with everything on disk (warm).

    python tools/bench.py start                                  # all shipped scenes, on the CPU
    python tools/bench.py start omni_push_box --device cuda:0 --json start.json

Every start is a program of its own. What counts as cold is the scene's own: one scene is started before, so that the
kernels that all scenes share are there (``first`` in the JSON has what that took), in a cache that is thrown away. The
JSON has processor time, too, which says more of a machine that is busy.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.table import Table
from shared.files import write_json

BENCH = Path(__file__).parents[1] / "bench.py"
PARTS = ("import", "scene", "compile", "build", "plans")
"""Importing warpmpc and starting Warp; reading and compiling the scene; the rollouts' kernel; the rest of the
controller; the first two plans, which load the other kernels."""


class Watch:
    """Wall and processor time by part; the latter hardly depends on what else the machine does."""

    def __init__(self):
        self.wall, self.cpu = dict.fromkeys(PARTS, 0.0), dict.fromkeys(PARTS, 0.0)

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        """Add what is done within to a part; of parts within one another the inner one alone counts."""
        clocks = time.perf_counter(), time.process_time()
        before = sum(self.wall.values()), sum(self.cpu.values())
        yield
        for times, clock, now, inner in zip(
            (self.wall, self.cpu), clocks, (time.perf_counter(), time.process_time()), before, strict=True
        ):
            times[part] += now - clock - (sum(times.values()) - inner)


def start(source: str, engine: str, device: str) -> dict:
    """Start a scene in this process up to its second plan; seconds by part, and the engine."""
    watch = Watch()
    with watch("import"):
        import warpmpc
        from warpmpc.cli.setup import start_warp
        from warpmpc.compiling import compile_kernel
        from warpmpc.engine import fused, kinematic
        from warpmpc.model.compiled import compile_scene

        start_warp()
    with watch("scene"):
        scene = warpmpc.load_scene(source)
        compiled = compile_scene(scene)

    def timed(*args, **keys) -> None:
        with watch("compile"):
            compile_kernel(*args, **keys)

    kinematic.compile_kernel = fused.compile_kernel = timed
    with watch("build"):
        controller = warpmpc.Controller(scene, engine=engine, device=device, compiled=compiled)
        plant = warpmpc.Plant(scene, compiled=compiled, task=controller.task)
        state = plant.observe()
    with watch("plans"):
        controller.step(state)
        controller.step(state)
    return {"engine": controller.engine.name, "wall_s": watch.wall, "cpu_s": watch.cpu}


def in_a_process(source: str, engine: str, device: str, cache: Path) -> dict:
    """Start a scene in a new process with caches in a folder."""
    environment = os.environ | {"WARP_CACHE_PATH": str(cache / "warp"), "WARPMPC_CACHE": str(cache / "warpmpc")}
    command = [sys.executable, BENCH, "start", source, "--engine", engine, "--device", device, "--here"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode != 0:
        return {"error": done.stderr.strip().splitlines()[-1]}
    return json.loads(done.stdout.strip().splitlines()[-1])


def main(arguments: list[str]) -> None:
    """Start scene after scene, twice each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help="scenes, shipped ones by default")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--here", action="store_true", help="start the scene in this process, print its times as JSON")
    options = parser.parse_args(arguments)
    if options.here:
        print(json.dumps(start(options.scenes[0], options.engine, options.device)))
        return
    import warpmpc

    names, place = options.scenes or sorted(warpmpc.shipped_scenes()), (options.engine, options.device)
    table, rows = Table("scene", "engine", *PARTS, "all", title="seconds, cold / warm", box=None), []
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder)
        first = in_a_process("point_reach", *place, cache)
        for name in names:
            own = cache / "own" if name == "point_reach" else cache  # that one's has been compiled
            cold, warm = (in_a_process(name, *place, own) for _ in range(2))
            rows.append({"scene": name, "cold": cold, "warm": warm})
            cells = [f"{_seconds(cold, part)} / {_seconds(warm, part)}" for part in (*PARTS, "all")]
            table.add_row(name, cold.get("engine", cold.get("error", "")), *cells)
            print(name, *cells, file=sys.stderr, flush=True)
            if options.json:
                from shared.machine import machine

                report = {"machine": machine(), "first": first, "rows": rows}
                write_json(options.json, report)
    Console(width=None if sys.stdout.isatty() else 150).print(table)


def _seconds(found: dict, part: str) -> str:
    if "wall_s" not in found:
        return "-"
    return f"{sum(found['wall_s'].values()) if part == 'all' else found['wall_s'][part]:.1f}"
