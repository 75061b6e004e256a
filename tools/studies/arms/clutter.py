# SPDX-License-Identifier: Apache-2.0
"""Runs storm_cloud in random clutters whose goals the arm can take up freely, and says what it touched.

Three forms of the collision with the cloud stand side by side: ``distance`` as shipped, ``binary`` [S11] on geometry,
and ``learned``, binary by networks (STORM's checker), variants of the scene.

A seed draws clutter and goal. It counts if inverse kinematics finds a posture at the goal, within the joints' limits,
whose links are so far from all obstacles (``--free``); what the planner sees plays no part in that.

    python tools/study.py clutter --seeds 0:40 --count 20
    python tools/study.py clutter --form distance binary learned --seeds 0:60 --count 20 --jobs 16 --out build/clutter
    python tools/study.py clutter --set cloud.seen.behind=0.1

Finished runs are kept in OUT/clutter.jsonl and never repeated; the same command goes on after an interruption.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation
from shared.intervals import rate
from shared.measure import Clearance

import warpmpc
from warpmpc.loop.run.episode import Episode
from warpmpc.loop.run.workers import FORMS, FinishedJobs, open_workers
from warpmpc.scene.model.pairs import self_pairs
from warpmpc.scene.model.spheres import fit_spheres
from warpmpc.scene.origin import code_digest

if TYPE_CHECKING:
    from collections.abc import Iterable

    from warpmpc import Plant

STARTS = 40
"""Postures that inverse kinematics begins from."""
STEPS = 60
"""Steps of each search."""
APART = 0.01
"""How far the links of a posture must be from one another [m]."""
SCENES = {"distance": "storm_cloud", "binary": "storm_cloud:binary", "learned": "storm_cloud:learned"}
"""Scene of each form of the cost."""
LIMIT = 0.02
"""How far from the joints' limits a posture must stay [rad]."""


class Reach:
    """Postures of a plant's robot at its goal, and how far they are from everything.

    Args:
        plant: The plant; its goal is that of a frame.
    """

    def __init__(self, plant: Plant):
        layout, compiled = plant.layout, plant.compiled
        self.clearance = Clearance(compiled)
        self.model, self.data = self.clearance.model, self.clearance.data
        frame = layout.frame(plant.scene.goal.target)
        self._body = self.model.body(compiled.body_name[layout.frame_body[frame]]).id
        self._pose = layout.frame_pose[frame].astype(float)
        self._goal = plant.goal.astype(float)
        joints = [self.model.joint(compiled.joint_name[dof]) for dof in layout.actuator_dof]
        self._q, self._dof = ([int(getattr(j, name)[0]) for j in joints] for name in ("qposadr", "dofadr"))
        self._low, self._high = np.array([j.range for j in joints]).T + np.array([[LIMIT], [-LIMIT]])
        spheres = fit_spheres(layout, range(layout.nb))
        bodies = {tuple(sorted(spheres.groups[g].body for g in pair)) for pair in self_pairs(layout, spheres)}
        own = self.clearance.robot
        self._own = [(a, b) for a, i in own for b, k in own if i < k and (i, k) in bodies]

    def best(self, seed: int, enough: float) -> float:
        """Distance from obstacles of a posture at the goal [m]: the first that is enough, else the largest found."""
        rng, found = np.random.default_rng(seed), -np.inf
        for start in rng.uniform(self._low, self._high, (STARTS, len(self._low))):
            if self._solve(start):
                found = max(found, self._free())
            if found >= enough:
                break
        return found

    def _solve(self, q: np.ndarray) -> bool:
        """Damped least squares from a posture to the goal; whether it got there."""
        model, data, q = self.model, self.data, q.copy()
        jacobian = np.zeros((6, model.nv))
        for _ in range(STEPS):
            data.qpos[self._q] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            turn = Rotation.from_matrix(data.xmat[self._body].reshape(3, 3))
            at = data.xpos[self._body] + turn.apply(self._pose[:3])
            goal, now = Rotation.from_quat(self._goal[3:]), turn * Rotation.from_quat(self._pose[3:])
            error = np.concatenate([self._goal[:3] - at, (goal * now.inv()).as_rotvec()])
            if np.abs(error[:3]).max() < 1e-3 and np.abs(error[3:]).max() < 1e-2:
                return True
            mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], at, self._body)
            j = jacobian[:, self._dof]
            q = np.clip(q + j.T @ np.linalg.solve(j @ j.T + 1e-3 * np.eye(6), error), self._low, self._high)
        return False

    def _free(self) -> float:
        """Distance of the posture in ``data`` from obstacles [m]; minus infinity if its links come too close."""
        if self._least(self._own) < APART:
            return -np.inf
        fixed = [geom for geom, _ in self.clearance.obstacle]
        moving = [geom for geom, _ in self.clearance.robot if self.model.geom_bodyid[geom] != 0]
        return self._least((a, b) for a in moving for b in fixed)

    def _least(self, pairs: Iterable[tuple[int, int]]) -> float:
        """Least distance of pairs of geoms [m]."""
        return min(mujoco.mj_geomDistance(self.model, self.data, *pair, 1.0, None) for pair in pairs)


def run(seed: int, overrides: list[str], least: float, form: str = "distance") -> dict:
    """Outcome of a seed."""
    scene = warpmpc.load_scene(SCENES[form], overrides=overrides)
    episode = Episode(scene, seed=seed)
    plant = episode.plant
    free = Reach(plant).best(seed, least)
    out = {"form": form, "seed": seed, "free_m": free, "counts": bool(free >= least)}
    if not out["counts"]:
        return out
    look, nearest = Clearance(plant.compiled), [np.inf]
    start = time.process_time()

    def note(controller: object, plant: Plant, control: np.ndarray) -> None:
        nearest.append(look(plant.body_q))

    result = episode.run(on_step=note)
    touched = {pair: force for pair, force in plant.contact.forces.items() if force > 0.0}
    return {
        **out,
        "reached": result.success,
        "time_s": result.sim_time,
        "position_mm": 1e3 * result.position_error,
        "rotation_rad": plant.error.rotation,
        "touched": touched,
        "nearest_m": min(nearest),
        "points": len(plant.task[scene.cloud[0].name]),
        "plan_ms": result.plan_ms["p50"],
        "cpu_s": time.process_time() - start,
    }


def collected(args: argparse.Namespace) -> list[dict]:
    """Results of all forms by seed, until enough seeds of each count; those that are kept are not run again."""
    from warpmpc.cli.setup import start_warp

    records, rows = FinishedJobs(args.out / "clutter.jsonl"), []
    seeds, overrides = range(*map(int, args.seeds.split(":"))), ["engine.threads=1", *args.set]
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    with workers:
        for form in args.form:
            keys = {seed: json.dumps([form, seed, overrides, args.free, code_digest()]) for seed in seeds}
            jobs = {
                seed: workers.submit(run, seed, overrides, args.free, form)
                for seed in seeds
                if keys[seed] not in records.by_key
            }
            counted = 0
            for seed in seeds:
                if counted == args.count:
                    if seed in jobs:
                        jobs[seed].cancel()
                    continue
                if seed in jobs:
                    records.add(keys[seed], jobs[seed].result())
                    print(json.dumps(records.by_key[keys[seed]]), flush=True)
                rows.append(records.by_key[keys[seed]])
                counted += rows[-1]["counts"]
    return rows


def main(arguments: list[str]) -> None:
    """Run, print, and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--form", nargs="+", choices=SCENES, default=["distance"], help="of the cost (default distance)"
    )
    parser.add_argument("--seeds", default="0:40", help="first:end of the seeds to look at")
    parser.add_argument("--count", type=int, default=20, help="clutters to run")
    parser.add_argument("--free", type=float, default=0.04, help="least distance of a posture at the goal [m]")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=Path("build/clutter"), help="folder (default build/clutter)")
    args = parser.parse_args(arguments)
    rows = collected(args)
    ran = [row for row in rows if row["counts"]]
    table = Table(box=None, title=f"{len(ran)} runs of {len(rows)} seeds and forms")
    heads = ("form", "seed", "free [mm]", "reached", "time [s]", "off [mm]", "off [rad]", "nearest [mm]", "touched [N]")
    for head in heads:
        table.add_column(head, justify="right")
    for row in ran:
        touched = ", ".join(f"{pair} {force:.1f}" for pair, force in row["touched"].items())
        reached = "yes" if row["reached"] else "no"
        figures = (f"{row[k]:.{n}f}" for k, n in (("time_s", 2), ("position_mm", 1), ("rotation_rad", 3)))
        near, own = f"{1e3 * row['nearest_m']:.0f}", (row["form"], str(row["seed"]))
        table.add_row(*own, f"{1e3 * row['free_m']:.0f}", reached, *figures, near, touched)
    Console(width=150).print(table)
    for form in args.form:
        own = [row for row in ran if row["form"] == form]
        if own:
            print(summary(form, own))


def summary(form: str, rows: list[dict]) -> str:
    """One line about the runs of a form: how many reach and touch, with 95 % intervals, and the median plan."""
    parts = []
    for name, key in (("reached", "reached"), ("touched something", "touched")):
        count = sum(bool(row[key]) for row in rows)
        _, low, high, _ = astuple(rate(count, len(rows)))
        parts.append(f"{name} {count} of {len(rows)} ({low:.0%} to {high:.0%})")
    return f"{form}: {', '.join(parts)}, plan {np.median([row['plan_ms'] for row in rows]):.2f} ms"
