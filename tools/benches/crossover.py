# SPDX-License-Identifier: Apache-2.0
"""Time plans over the number of samples on the CPU and on a GPU, and tell from how many samples the GPU is cheaper.

    python tools/bench.py crossover --limit 230                        # every scene, one thread, all threads, the GPU
    python tools/bench.py crossover --scenes mobile_pick quadruped_walk --device cpu
    python tools/bench.py crossover --limit 0 --docs docs              # the table and the picture of what is there

Scenes plan as shipped, but for the number of samples, at states of a closed loop. Kernels are compiled first, in
processes side by side; what is not ready then is left out. Few sizes of all scenes come before many of one. Times are
kept in OUT/crossover.json after every scene; the same command goes on with those that are missing. OUT/crossover.png
has a panel for each scene. The crossover is interpolated between two sizes, linearly in the logarithms.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import wait
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from shared.files import write_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warpmpc import State
    from warpmpc.scene.model.compiled import CompiledScene

SCENES = (
    *("point_reach", "panda_reach", "panda_push", "panda_push_objects", "omni_push_box", "omni_push_sphere"),
    *("diff_push_box", "mobile_pick", "quadruped_walk", "humanoid_stand"),
)
SAMPLES = (16, 256, 4096, 64, 1024, 8192, 512, 128, 2048, 32)
"""Numbers of samples, those first that tell most."""
GPU = "cuda:0"
PLANS, SECONDS, LONGEST = 40, 0.12, 0.1
"""Most plans of a time, how long they may take together [s], and the longest plan that is timed on the CPU [s]."""
PREPARING = 0.5
"""Share of the time that kernels may take to compile."""


@dataclass(frozen=True)
class Place:
    """Where plans are made."""

    device: str
    threads: int | None
    """Threads on the CPU."""

    @property
    def name(self) -> str:
        """Name in the figures."""
        return "GPU" if self.threads is None else f"{self.threads} thread{'s' if self.threads > 1 else ''}"

    def overrides(self, samples: int) -> list[str]:
        """Changes of a scene."""
        return [f"planner.samples={samples}", *([f"engine.threads={self.threads}"] if self.threads else [])]


def places(machine: dict, device: str) -> list[Place]:
    """One thread, all threads and the GPU, as far as they are there and asked for."""
    found = [Place("cpu", count) for count in sorted({1, machine["cores"]})]
    return found + ([Place(GPU, None)] if machine["gpus"] and device != "cpu" else [])


def crossover(cpu: dict[int, float], gpu: dict[int, float]) -> float | str | None:
    """Number of samples from which a GPU is faster, a bound where all sizes agree; None with nothing to compare.

    Args:
        cpu: Samples → time of a plan.
        gpu: As ``cpu``.
    """
    common = sorted(set(cpu) & set(gpu))
    if not common:
        return None
    x = np.log(common)
    gap = np.log([cpu[n] / gpu[n] for n in common])  # above zero where the GPU is faster
    slower = np.flatnonzero(gap <= 0.0)
    if not len(slower):
        return f"< {common[0]}"
    i = int(slower[-1])
    if i == len(common) - 1:
        return f"> {common[-1]}"
    return float(np.exp(x[i] - gap[i] * (x[i + 1] - x[i]) / (gap[i + 1] - gap[i])))


def prepare(scene: str, device: str, samples: int) -> None:
    """Compile what plans of a scene need, in a separate process."""
    import warpmpc

    one = warpmpc.load_scene(scene, overrides=[f"planner.samples={samples}"])
    controller = warpmpc.Controller(one, engine="fused", device=device, seed=0)
    controller.step(warpmpc.Plant(one).observe())
    controller.engine.close()


def compiled_all(scenes: Sequence[str], where: Sequence[Place], cores: int, seconds: float) -> dict[str, set[str]]:
    """Compile side by side; the devices on which a scene is ready, by scene.

    On a GPU few samples and many are two programs.
    """
    from warpmpc.cli.setup import start_warp
    from warpmpc.loop.run.workers import open_workers

    devices = dict.fromkeys(place.device for place in where)
    sizes = {device: (SAMPLES[0],) if device == "cpu" else (SAMPLES[0], max(SAMPLES)) for device in devices}
    workers, _ = open_workers(str(max(1, min(cores, len(scenes) * sum(map(len, sizes.values()))))), prepare=start_warp)
    with workers:
        futures = {
            workers.submit(prepare, scene, device, size): (scene, device)
            for device in reversed(devices)
            for scene in scenes
            for size in sizes[device]
        }
        done, _ = wait(futures, timeout=seconds)
        late = {job: f"not compiled in {seconds:.0f} s" for future, job in futures.items() if future not in done}
        late |= {futures[future]: str(error) for future in done if (error := future.exception())}
    for (scene, device), why in sorted(late.items()):
        print(f"{scene} on {device}: left out: {why}", flush=True)
    return {scene: {device for device in devices if (scene, device) not in late} for scene in scenes}


class Bench:
    """A scene whose plans are timed: states of a closed loop, and the scene compiled."""

    def __init__(self, scene: str):
        self.scene = scene
        self._ready: tuple[CompiledScene, list[State]] | None = None

    def _run(self) -> tuple[CompiledScene, list[State]]:
        """The compiled scene and eight states of its first 24 controls."""
        import warpmpc
        from warpmpc.scene.model.compiled import compile_scene

        scene = warpmpc.load_scene(self.scene)
        compiled = compile_scene(scene)
        controller = warpmpc.Controller(scene, engine="fused", device="cpu", seed=0, compiled=compiled)
        plant = warpmpc.Plant(scene, compiled=compiled, task=controller.task)
        states = []
        for _ in range(24):
            states.append(plant.observe())
            if plant.done:
                break
            plant.apply(controller.step(states[-1]))
        controller.engine.close()
        return compiled, states[::3]

    def time(self, place: Place, samples: int) -> dict[str, float]:
        """Time of plans [ms]."""
        from shared.plan_times import time_plans

        import warpmpc

        self._ready = self._ready or self._run()
        compiled, states = self._ready
        scene = warpmpc.load_scene(self.scene, overrides=place.overrides(samples))
        controller = warpmpc.Controller(scene, engine="fused", device=place.device, seed=0, compiled=compiled)
        times, _ = time_plans(controller, states, plans=PLANS, seconds=SECONDS)
        controller.engine.close()
        p10, p50, p90 = np.percentile(times, [10, 50, 90]).tolist()
        return {"p10": p10, "p50": p50, "p90": p90, "plans": len(times)}


def predicted(times: dict[str, dict], samples: int) -> float:
    """Time of a plan [s] as what was measured with fewer samples lets expect; 0 where nothing was."""
    fewer = [int(n) for n in times if int(n) < samples]
    return 1e-3 * times[str(max(fewer))]["p50"] * samples / max(fewer) if fewer else 0.0


def measure(report: dict, where: Sequence[Place], ready: dict[str, set[str]], end: float, out: Path) -> None:
    """Fill in what is missing in a report, scene by scene and size by size, until the time is over."""
    benches = {scene: Bench(scene) for scene in ready}
    for samples in SAMPLES:
        for scene, bench in benches.items():
            found = report["scenes"].setdefault(scene, {})
            for place in where:
                times = found.setdefault(place.name, {})
                slow = place.threads is not None and predicted(times, samples) > LONGEST
                if place.device not in ready[scene] or str(samples) in times or slow:
                    continue
                if time.perf_counter() > end:
                    print("no time for more", flush=True)
                    return
                times[str(samples)] = bench.time(place, samples)
            write_json(out, report)
            told = ", ".join(f"{name} {t[str(samples)]['p50']:.3g}" for name, t in found.items() if str(samples) in t)
            print(f"{scene:20} {samples:5} samples: {told} ms", flush=True)


def crossings(found: dict[str, dict]) -> dict[str, float | str | None]:
    """Crossover with the GPU by place on the CPU."""
    medians = {name: {int(n): t["p50"] for n, t in times.items()} for name, times in found.items()}
    return {name: crossover(times, medians.get("GPU", {})) for name, times in medians.items() if name != "GPU"}


def shown(value: float | str | None) -> str:
    """A crossover, two digits."""
    if value is None or isinstance(value, str):
        return value or "-"
    return f"{float(f'{value:.2g}'):.0f}"


def figures(report: dict) -> dict:
    """The table of the documentation."""
    from warpmpc import load_scene

    machine, rows = report["machine"], []
    names = list(dict.fromkeys(n for found in report["scenes"].values() for n in found if n != "GPU"))
    for scene, found in report["scenes"].items():
        own, crossed = load_scene(scene).planner.samples, crossings(found)
        rows.append([f"`{scene}`", str(own), *(shown(crossed.get(name)) for name in names)])
    columns = ["scene", "samples as shipped", *(f"GPU cheaper than {name} from" for name in names)]
    where = f"{machine['cores']} cores of {machine['cpu']}; {', '.join(machine['gpus']) or 'no GPU'}"
    made = {"machine": where, "date": report["date"], "command": report["command"], "rows": rows}
    return {"columns": columns, "groups": [made]}


def picture(report: dict, path: Path) -> None:
    """A panel for each scene: times over samples, with the crossovers."""
    from matplotlib.figure import Figure

    scenes = report["scenes"]
    wide = min(5, len(scenes))
    high = -(-len(scenes) // wide)
    figure = Figure(figsize=(2.6 * wide, 2.3 * high + 0.4), layout="constrained")
    panels = np.ravel(figure.subplots(high, wide, squeeze=False))
    for axes, (scene, found) in zip(panels, scenes.items(), strict=False):
        for name, times in found.items():
            n = sorted(map(int, times))
            axes.loglog(n, [times[str(k)]["p50"] for k in n], marker=".", label=name)
        crossed = crossings(found)
        for value in crossed.values():
            if isinstance(value, float):
                axes.axvline(value, color="black", linewidth=0.6, linestyle=":")
        lines = [f"{name}: {shown(value)}" for name, value in crossed.items() if value is not None]
        text = "\n".join(["GPU cheaper from", *lines] if lines else [])
        axes.text(0.04, 0.95, text, transform=axes.transAxes, va="top", fontsize=7)
        axes.set_title(scene, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    for axes in panels[len(scenes) :]:
        axes.set_visible(False)
    handles = max((axes.get_legend_handles_labels() for axes in panels), key=lambda found: len(found[1]))
    figure.legend(*handles, loc="outside upper center", ncols=len(handles[1]), fontsize=8)
    figure.supxlabel("samples", fontsize=9)
    figure.supylabel("plan [ms]", fontsize=9)
    figure.savefig(path, dpi=110)


def opened(path: Path, machine: dict, command: str) -> dict:
    """A report begun before on this machine, or a new one.

    Raises:
        ValueError: If it is another machine's, and there is something to measure.
    """
    who = {key: machine[key] for key in ("cpu", "cores", "gpus")}
    if path.exists():
        report = json.loads(path.read_text(encoding="utf-8"))
        if any(report["machine"][key] != value for key, value in who.items()):
            raise ValueError(f"{path} is of another machine ({report['machine']['cpu']}); choose another --out")
        return report
    return {"date": time.strftime("%Y-%m-%d"), "command": command, "machine": machine, "scenes": {}}


def main(arguments: list[str]) -> None:
    """Compile, measure, tell and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--device", choices=("all", "cpu"), default="all", help="where to plan (default all there is)")
    parser.add_argument("--limit", type=float, default=230.0, help="longest time, compiling too [s] (default 230)")
    parser.add_argument("--out", type=Path, default=Path("build/crossover"), help="folder of the results")
    parser.add_argument("--docs", type=Path, help="folder of pages that get data/crossover.json and crossover.png, too")
    args = parser.parse_args(arguments)
    began = time.perf_counter()
    from shared.machine import machine

    from warpmpc.cli.setup import start_warp

    start_warp()
    out = args.out / "crossover.json"
    if args.limit > 0.0:
        here = machine()
        limited = [f"--limit {args.limit:g}", *([f"--device {args.device}"] if args.device != "all" else [])]
        report = opened(out, here, " ".join(["python tools/bench.py crossover", *limited]))
        where = places(here, args.device)
        ready = compiled_all(args.scenes, where, here["cores"], PREPARING * args.limit)
        print(f"compiled in {time.perf_counter() - began:.0f} s", flush=True)
        measure(report, where, ready, began + args.limit, out)
    else:
        report = json.loads(out.read_text(encoding="utf-8"))
    for scene, found in report["scenes"].items():
        crossed = ", ".join(f"{name} {shown(value)}" for name, value in crossings(found).items())
        print(f"{scene:20} GPU cheaper from: {crossed}")
    picture(report, args.out / "crossover.png")
    if args.docs:
        write_json(args.docs / "data" / "crossover.json", figures(report))
        picture(report, args.docs / "crossover.png")
