#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Whether a change moves any command: record what the planner sends on the CPU, compare bit for bit.

    python tools/gate.py record before.npz                    # on the old code
    python tools/gate.py compare before.npz                   # on the new code, same machine
    python tools/gate.py compare before.npz --only @newton    # one engine, scene or setting alone

Every cell is a closed loop of a few plans from a fixed seed: each shipped scene with the engine that users get, some
scenes with other engines, and settings of the planner that no shipped scene has. Commands depend on the
processor, so a record holds for the machine it was made on. Where an engine writes source for a scene, the record has
the source's digest, too: a compiler may contract products and sums of other source in another way, so that a command
that moves with its source may be rounding, and one that moves without is not. The record has the MuJoCo models of the
shipped scenes, of their variants and of the robots of PyPI packages, too, field by field (``--only model:``).
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from shared.progress import Bar

PLANS = 20
SEEDS = (0, 1)
VARIANTS = {
    "go2_walk": ("shoved",),
    "hand_cube": ("fine",),
    "humanoid_get_up": ("paper",),
    "mobile_pick": ("knocked",),
    "omni_push_box": ("B", "kicked", "shoved", "noisy"),
    "omni_push_sphere": ("B",),
    "panda_push": ("pose_2",),
    "panda_push_objects": ("E_left",),
    "panda_reach": ("meshes",),
    "quadruped_walk": ("paper",),
    "storm_balance": ("moving",),
    "storm_track": ("walls",),
}
SETTINGS = (
    ("planner.method=cem", "planner.iterations=2", "planner.elites=6"),
    ("planner.method=icem",),
    ("planner.method=dial",),
    ("planner.method=tsallis", "planner.elites=16"),
    (
        *("planner.method=predictive_sampling", "planner.iterations=2", "planner.noise.source=halton"),
        *("planner.noise.spread=[0.02, 1.0]", "planner.noise.constant=0.1", "planner.noise.null_sample=true"),
    ),
    ("planner.samples=32", "planner.covariance.form=full", "planner.covariance.kappa=0.01"),
    ("planner.samples=16", "planner.stage_risk=0.2"),
    ("planner.spline=linear", "planner.noise.source=sobol"),
    ("planner.spline=bspline", "planner.noise.shape=coloured"),
    ("planner.temperature.eta=false", "planner.temperature.ess=8", "planner.noise.source=random"),
    ("planner.noise.shape=comb", "planner.noise.null_sample=false"),
    ("planner.knots=steps", "planner.spline=zero", "planner.dt=0.04", "planner.noise.shape=bspline"),
    ("planner.randomize=false", "planner.step_size=0.5", "engine.threads=1"),
    ("planner.horizon=5", "planner.dt=[0.04, 0.04, 0.08, 0.08, 0.16]"),
    ("planner.horizon=5", "planner.dt=0.04", "planner.ancillary=[{recall = 0.4}]"),
)
"""Of the planner, in :data:`SETTINGS_OF` each."""
SETTINGS_OF = ("omni_push_box", "point_reach")
RISKS = ("mean", "worst", "best", "cvar", "var", "exponential")
DERIVATIVES = ("gradient_descent", "ilqg", "ilqs")
PHASES = {
    "go2_jump": ("phase.crouch.after=0.06", "phase.leap.after=0.06"),
    "quadruped_walk": ("phase.first.after=0.06", "phase.second.after=0.06"),
}
"""Scenes whose phases follow each other within the plans of a cell."""
OTHER_ENGINES = {
    "mujoco": {
        "omni_push_box": (),
        "panda_reach": (),
        "cartpole_swingup": (),
        "quadruped_walk": ("planner.samples=16",),
        "hand_cube": ("planner.samples=16",),
        "box_carry": ("planner.samples=16",),
    },
    "mujoco_warp": {
        "pendulum": ("planner.samples=8", "planner.horizon=8"),
        "omni_push_box": ("planner.samples=8", "planner.horizon=4"),
    },
    "newton": {
        "omni_push_box": ("planner.samples=8", "planner.horizon=4"),
    },
}
"""Scenes and overrides with engines that users get when they ask for them."""


@dataclass(frozen=True)
class Cell:
    """A closed loop that is recorded."""

    scene: str
    engine: str
    overrides: tuple[str, ...] = ()
    seed: int = 0

    def __str__(self) -> str:
        return " ".join((f"{self.scene}@{self.engine}", *self.overrides, f"seed={self.seed}"))


def cells() -> Iterator[Cell]:
    """All cells, those of one scene one after the other."""
    import warpmpc

    for name in sorted(warpmpc.shipped_scenes()):
        asked = str(warpmpc.load_scene(name).engine.name)
        own = "fused" if asked == "auto" else asked
        for variant in ("", *VARIANTS.get(name, ())):
            for seed in SEEDS:
                yield Cell(name + (f":{variant}" if variant else ""), own, seed=seed)
        if name in PHASES:
            yield Cell(name, own, PHASES[name])
        for engine, scenes in OTHER_ENGINES.items():
            if name in scenes:
                yield Cell(name, engine, scenes[name])
    for name in SETTINGS_OF:
        for overrides in SETTINGS:
            yield Cell(name, "fused", overrides)
    for risk in RISKS:
        yield Cell("omni_push_box", "fused", ("planner.samples=16", "planner.domains=4", f"planner.risk={risk}"))
    for method in DERIVATIVES:
        yield Cell("cartpole_swingup", "fused", (f"planner.method={method}", "planner.samples=32"))


@contextmanager
def sources() -> Iterator[Callable[[], str]]:
    """Watch what native source warpmpc writes; functions of a module are the same for all scenes and do not count.

    Yields:
        What tells the digest of all of it so far, empty where there was none.
    """
    import warp as wp

    make, found = wp.func_native, []

    def noting(snippet: str, *args: object, **kwargs: object) -> Callable:
        def decorate(function: Callable) -> object:
            if "<locals>" in function.__qualname__ and function.__module__.startswith("warpmpc"):
                found.append(snippet)
            return make(snippet, *args, **kwargs)(function)

        return decorate

    wp.func_native = noting
    try:
        yield lambda: hashlib.sha256("\0".join(sorted(found)).encode()).hexdigest() if found else ""
    finally:
        wp.func_native = make


@dataclass(frozen=True)
class Run:
    """What became of a cell."""

    rows: np.ndarray
    """Numbers after every plan ``[plans, columns]``."""
    columns: np.ndarray
    """What each column is."""
    source: str
    """Digest of the source that was written for the scene, empty where there was none."""
    seconds: float = 0.0
    """How long it took [s]."""


def play(cell: Cell) -> Run:
    """Run a cell."""
    import warp as wp

    import warpmpc
    from warpmpc.loop.run.episode import Episode

    wp.config.log_level = wp.LOG_ERROR
    start, rows, columns = time.perf_counter(), [], []
    with sources() as digest:
        scene = warpmpc.load_scene(cell.scene, overrides=cell.overrides)
        episode = Episode(scene, seed=cell.seed, engine=cell.engine, device="cpu")
        controller, plant = episode.controller, episode.plant
        for _ in range(PLANS):
            command = controller.step(plant.observe())
            plant.apply(command)
            numbers = {"command": command, "joint_q": plant.state.joint_q}
            numbers |= {f"cost of {term}": [cost] for term, cost in controller.info.terms.items()}
            rows.append(np.concatenate(list(numbers.values())))
            columns = [name for name, values in numbers.items() for _ in values]
        controller.engine.close()
    return Run(np.array(rows, np.float32), np.array(columns), digest(), time.perf_counter() - start)


def model_names() -> Iterator[str]:
    """Scenes and robots whose MuJoCo models are recorded."""
    import robots

    import warpmpc
    from warpmpc.scene.load import variants

    for name in sorted(warpmpc.shipped_scenes()):
        yield f"model:{name}"
        yield from (f"model:{name}:{variant}" for variant in variants(name))
    yield from (f"model:{path}" for _, _, path in robots.robots())


def model_of(name: str) -> Run:
    """The fields of one MuJoCo model: a row of one number a field, made of its digest."""
    import robots

    import warpmpc
    from warpmpc.scene.model.compiled import compile_scene
    from warpmpc.scene.model.mujoco_model import Options, make_world

    start, source = time.perf_counter(), name.removeprefix("model:")
    scene = robots.scene_of(Path(source)) if source.startswith("/") else warpmpc.load_scene(source)
    try:
        model = make_world(compile_scene(scene), timestep=0.01, options=Options.of(scene.engine)).model
    except warpmpc.SceneError as error:
        return Run(np.zeros((1, 1), np.float32), np.array(["refused"]), str(error), time.perf_counter() - start)
    found = {}
    for part, of in (("", model), ("opt.", model.opt), ("stat.", model.stat)):
        for field in dir(of):
            value = getattr(of, field)
            if not field.startswith("_") and isinstance(value, np.ndarray | int | float | bytes):
                held = value if isinstance(value, bytes) else np.ascontiguousarray(value).tobytes()
                found[part + field] = int.from_bytes(hashlib.sha256(held).digest()[:3])
    rows = np.array([list(found.values())], np.float32)  # 24 bits: exact in single precision
    return Run(rows, np.array(list(found)), "", time.perf_counter() - start)


def write(found: dict[str, Run], file: Path) -> None:
    """Write a record of cells by their labels."""
    np.savez(file, **{f"{name}/{key}": value for name, run in found.items() for key, value in vars(run).items()})


def read(file: Path) -> dict[str, Run]:
    """Cells of a record by their labels."""
    with np.load(file) as record:
        names = [key.removesuffix("/rows") for key in record if key.endswith("/rows")]
        return {
            name: Run(record[f"{name}/rows"], record[f"{name}/columns"], str(record[f"{name}/source"]))
            for name in names
        }


def difference(now: Run, before: Run) -> str | None:
    """How the numbers of a cell differ from those of a record; None where they are the same bit for bit."""
    if now.rows.shape != before.rows.shape or (now.columns != before.columns).any():
        return f"{before.rows.shape} numbers of other things before, {now.rows.shape} now"
    moved = (now.rows != before.rows) & ~(np.isnan(now.rows) & np.isnan(before.rows))
    if not moved.any():
        return None
    by = np.where(moved, np.abs(now.rows - before.rows), 0.0)
    parts = []
    for name in dict.fromkeys(now.columns[moved.any(axis=0)].tolist()):
        own, own_by = moved[:, now.columns == name].any(axis=1), by[:, now.columns == name].max(axis=1)
        first = int(np.argmax(own))
        parts.append(f"{name} from plan {first} by {own_by[first]:.3g}, at most by {own_by.max():.3g}")
    return "; ".join(parts)


def compare(found: dict[str, Run], before: dict[str, Run], *, whole: bool) -> int:
    """Print which cells differ from those of a record, and how.

    Args:
        found: Cells by their labels.
        before: Those of the record.
        whole: Whether all cells are found, so that one that is in the record alone is gone.

    Returns:
        How many cells differ or are gone.
    """
    shared = [name for name in found if name in before]
    moved = {name: how for name in shared if (how := difference(found[name], before[name]))}
    written = [name for name in shared if found[name].source or before[name].source]
    rewritten = [name for name in written if found[name].source != before[name].source]
    for name in found:
        source = "of other source" if name in rewritten else "of the same source"
        if name not in before:
            print(f"new      {name}")
        elif name in moved:
            print(f"MOVED    {name} ({source}): {moved[name]}")
        elif name in rewritten:
            print(f"same     {name} ({source})")
    gone = [name for name in before if name not in found] if whole else []
    for name in gone:
        print(f"GONE     {name}")
    print(f"{len(shared) - len(moved)} of {len(shared)} cells are bit-identical")
    print(f"{len(written) - len(rewritten)} of {len(written)} cells with source of their own have the same source")
    return len(moved) + len(gone)


def run_one(cell: Cell | str) -> Run:
    """Run a cell, or compile a model."""
    return model_of(cell) if isinstance(cell, str) else play(cell)


def main() -> int:
    """Command line of this tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["record", "compare"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="cells whose label contains this: @mujoco, storm_, method=cem")
    args = parser.parse_args()
    chosen = [cell for cell in (*cells(), *model_names()) if args.only in str(cell)]
    if not chosen:
        parser.error(f"no cell's label contains {args.only!r}")
    before = read(args.file) if args.what == "compare" else {}
    start, found = time.perf_counter(), {}
    with ProcessPoolExecutor(args.jobs) as pool, Bar(len(chosen)) as bar:
        for cell, run in zip(chosen, pool.map(run_one, chosen), strict=True):
            found[str(cell)] = run
            bar.step(str(cell))
    slowest = sorted(found, key=lambda name: -found[name].seconds)[:3]
    print(f"{len(found)} cells in {time.perf_counter() - start:.0f} s; those that took longest:")
    print("\n".join(f"  {found[name].seconds:.0f} s {name}" for name in slowest))
    if args.what == "record":
        write(found, args.file)
        return 0
    return 1 if compare(found, before, whole=not args.only) else 0


if __name__ == "__main__":
    sys.exit(main())
