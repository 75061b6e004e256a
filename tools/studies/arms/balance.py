# SPDX-License-Identifier: Apache-2.0
"""Balance a ball on a tray that an arm holds, the ball seen 30 times a second with noise: STORM's Fig. 6.

    python tools/study.py balance --runs 20 --seed 100             # runs, a line each
    python tools/study.py balance --scene storm_balance:moving --time 13 --runs 10
    python tools/study.py balance --model paper                    # planned with STORM's model of the ball
    python tools/study.py balance --draw docs/storm_balance.png    # of earlier runs' npz

Every run begins with the ball at rest somewhere off the centre. What is seen of it goes through a Kalman filter in the
tray's frame, which knows the rolling ball's model, too. Joints are seen as they are. OUT/SCENE_MODEL.npz has the
ball's paths.
"""

from __future__ import annotations

import argparse
import json
import math
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation
from shared.files import put_rows

import warpmpc
from warpmpc.cli.setup import start_warp
from warpmpc.loop.run.workers import FORMS, open_workers

if TYPE_CHECKING:
    from warpmpc import Plant, State

START = (0.06, 0.11)
"""How far from the centre the ball begins [m]."""
SETTLED = 4.0
"""Time after which the ball shall stay near the centre [s]."""
NEAR, PAPER = 0.02, 0.04
"""What is near, here and in the paper [m]."""
MODELS = {
    "ours": ("5/7 (Rᵀ(g - a))_xy", ()),
    "paper": ("(Rᵀg)_xy, the paper's", ("cost.rolling_ball.share=1.0", "cost.rolling_ball.carried=false")),
}
"""The ball's models in the planner."""
COLUMNS = (
    "ball's model in the planner",
    "scene",
    "within 2 cm from 4 s on",
    "within 4 cm (paper)",
    "furthest then [mm]",
)
GRAVITY = np.array([0.0, 0.0, -9.81])
SHARE = 5.0 / 7.0
"""Of the acceleration that a frictionless point would have, for a solid ball."""
SLACK = 1e-6
"""What a lapse of time may lack [s]: times are sums of steps."""


class Tray:
    """Where tray and ball of a plant are.

    Args:
        plant: A plant with the frame ``panda/tray`` and the object ``ball``.
    """

    def __init__(self, plant: Plant):
        self.plant, layout = plant, plant.layout
        self._tray, self._ball = (int(layout.frame_body[layout.frame(name)]) for name in ("panda/tray", "ball"))
        joint = int(np.flatnonzero(layout.joint_child == self._ball)[0])
        self.q, self.qd = int(layout.joint_q_start[joint]), int(layout.joint_qd_start[joint])
        """First joint coordinate and velocity of the ball."""

    def pose(self) -> np.ndarray:
        """Pose of the tray ``[7]``."""
        return self.plant.body_q[self._tray].astype(float)

    def centre(self) -> np.ndarray:
        """Place of the ball in the world ``[3]`` [m]."""
        return self.plant.body_q[self._ball, :3].astype(float)

    def ball(self) -> np.ndarray:
        """Place of the ball in the tray's frame ``[3]`` [m]."""
        pose = self.pose()
        return Rotation.from_quat(pose[3:]).inv().apply(self.centre() - pose[:3])


class Sight:
    """Observes the ball and estimates where it is and how fast, in the tray's frame.

    A Kalman filter for x and one for y, whose input is (5/7) (Rᵀ(g - a))_xy, R and a of the tray.

    Args:
        tray: Tray and ball.
        dt: Length of a control [s].
        rate: Observations a second.
        noise: Standard deviation of every coordinate [m].
        seed: Seed of that noise.
        unknown: Standard deviation of what accelerates the ball besides, over a control [m/s²].
    """

    def __init__(self, tray: Tray, dt: float, *, rate: float, noise: float, seed: int, unknown: float = 0.3):
        self._tray, self._dt, self._rate, self._noise = tray, dt, rate, noise
        self._rng, self._frame = np.random.default_rng([seed, 4]), -1
        self._move = np.array([[1.0, dt], [0.0, 1.0]])
        push = np.array([0.5 * dt * dt, dt])
        self._process, self._push = unknown**2 * np.outer(push, push), push
        self._x: np.ndarray | None = None  # place and velocity [2, 2], a column for each axis
        self._spread = np.diag([noise**2, 0.05**2])
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # place and velocity of the tray [m, m/s]

    def __call__(self, time: float, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Joint coordinates and velocities with the estimated ball in place of the true one.

        Args:
            time: The time [s].
            state: The true state.
        """
        pose = self._tray.pose()
        turn, before = Rotation.from_quat(pose[3:]), self._last
        velocity = np.zeros(3) if before is None else (pose[:3] - before[0]) / self._dt
        if self._x is not None and before is not None:
            acceleration = (velocity - before[1]) / self._dt
            pull = SHARE * turn.inv().apply(GRAVITY - acceleration)[:2]
            self._x = self._move @ self._x + np.outer(self._push, pull)
            self._spread = self._move @ self._spread @ self._move.T + self._process
        self._last = pose[:3], velocity
        if (frame := int((time + SLACK) * self._rate)) > self._frame:
            self._frame = frame
            seen = self._tray.centre() + self._rng.normal(0.0, self._noise, 3)
            self._correct(turn.inv().apply(seen - pose[:3])[:2])
        return self._written(state, pose, turn, velocity)

    def _correct(self, seen: np.ndarray) -> None:
        if self._x is None:
            self._x = np.array([seen, np.zeros(2)])
            return
        gain = self._spread[:, 0] / (self._spread[0, 0] + self._noise**2)
        self._x = self._x + np.outer(gain, seen - self._x[0])
        self._spread = self._spread - np.outer(gain, self._spread[0])

    def _written(
        self, state: State, pose: np.ndarray, turn: Rotation, velocity: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        q, qd, tray = state.joint_q.copy(), state.joint_qd.copy(), self._tray
        height = tray.plant.layout.shapes[tray.plant.layout.entity("ball").shapes[0]].scale[0]
        q[tray.q : tray.q + 3] = pose[:3] + turn.apply([*self._x[0], height])
        qd[tray.qd : tray.qd + 3] = velocity + turn.apply([*self._x[1], 0.0])
        return q, qd


@dataclass(frozen=True)
class Run:
    """Result of one ball."""

    seed: int
    path: np.ndarray
    """Place in the tray's frame after every control ``[n, 3]`` [m]."""
    dt: float
    """[s]"""
    hand: np.ndarray
    """Distance of the tray from its goal ``[n]`` [m]."""

    @property
    def distance(self) -> np.ndarray:
        """From the centre ``[n]`` [m]."""
        return np.linalg.norm(self.path[:, :2], axis=1)

    def to_json(self) -> dict[str, object]:
        """Text that is printed."""
        late = self.distance[round(SETTLED / self.dt) :]
        outside = np.flatnonzero(self.distance > NEAR)
        lost = self.path[-1, 2] < 0.0
        return {
            "seed": self.seed,
            "lost": bool(lost),
            "start_m": round(float(self.distance[0]), 4),
            "within_2cm_from_s": round((int(outside.max(initial=-1)) + 1) * self.dt, 2),
            "furthest_after_4s_m": None if lost or not len(late) else round(float(late.max()), 4),
            "rms_after_4s_m": None if lost or not len(late) else round(float(np.sqrt(np.mean(late**2))), 4),
            "hand_median_m": round(float(np.median(self.hand)), 4),
        }


def balance(name: str, seed: int, overrides: list[str], args: argparse.Namespace) -> Run:
    """One run from a start drawn from its seed."""
    rng = np.random.default_rng([seed, 3])
    scene = warpmpc.load_scene(name, overrides=overrides)
    (x, y, z), turn, away = scene.object[0].position, rng.uniform(0.0, 2.0 * math.pi), rng.uniform(*START)
    start = [x + away * math.cos(turn), y + away * math.sin(turn), z]
    scene = warpmpc.load_scene(name, overrides=[*overrides, f"object.ball.position={start}"])
    mpc = warpmpc.Controller(scene, seed=seed)
    plant = warpmpc.Plant(scene, seed=seed, task=mpc.task)
    tray = Tray(plant)
    sight = Sight(tray, scene.timing.control_dt, rate=args.rate, noise=args.noise, seed=seed)
    path, hand = [tray.ball()], []
    for _ in range(round(args.time / scene.timing.control_dt)):
        state = plant.observe()
        if args.noise > 0.0:
            q, qd = sight(plant.time, state)
            state = replace(state, joint_q=q, joint_qd=qd)
        plant.apply(mpc.step(state))
        path.append(tray.ball())
        hand.append(float(np.linalg.norm(tray.pose()[:3] - plant.goal[:3])))
        if path[-1][2] < 0.0:
            break
    return Run(seed, np.array(path), scene.timing.control_dt, np.array(hand))


def figures(args: argparse.Namespace, runs: list[Run]) -> list[str]:
    """The runs as a row of the table; a ball that is lost is nowhere near."""
    furthest = [math.inf if f is None else f for f in (run.to_json()["furthest_after_4s_m"] for run in runs)]
    within = [f"{sum(f <= near for f in furthest)} of {len(runs)}" for near in (NEAR, PAPER)]
    kept = [1e3 * f for f in furthest if f < math.inf]
    spread = f"{min(kept):.0f} to {max(kept):.0f}, median {np.median(kept):.0f}" if kept else "-"
    return [MODELS[args.model][0], f"`{args.scene}`", *within, spread]


def draw(folder: Path, scene: str, path: Path) -> None:
    """Draw the ball's ways in the tray's frame, and how far it is from the centre over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    plan, distance = figure.subplots(1, 2)
    run = np.load(folder / f"{file_name(scene, 'ours')}.npz")
    for way in run["paths"]:
        (line,) = plan.plot(100.0 * way[:, 0], 100.0 * way[:, 1], linewidth=0.8)
        plan.plot(*(100.0 * way[0, :2]), "o", color=line.get_color(), markersize=4)
        distance.plot(run["dt"] * np.arange(len(way)), 100.0 * np.linalg.norm(way[:, :2], axis=1), linewidth=0.8)
    turn = np.linspace(0.0, 2.0 * math.pi, 100)
    for near, style in ((NEAR, "-"), (PAPER, ":")):
        plan.plot(100.0 * near * np.cos(turn), 100.0 * near * np.sin(turn), style, color="tab:red")
        distance.axhline(100.0 * near, linestyle=style, color="tab:red", label=f"{100.0 * near:g} cm")
    plan.set(xlabel="x of the tray [cm]", ylabel="y of the tray [cm]", aspect="equal")
    distance.set(xlabel="time [s]", ylabel="ball from the centre [cm]", ylim=(0.0, None))
    distance.legend()
    for axes in (plan, distance):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=90)


def file_name(scene: str, model: str) -> str:
    """Name of the file of a scene's paths."""
    return f"{scene.replace(':', '_')}_{model}"


def main(arguments: list[str]) -> None:
    """Command line of this tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="storm_balance")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--time", type=float, default=10.0, help="length of a run [s] (default 10)")
    parser.add_argument("--rate", type=float, default=30.0, help="observations of the ball a second (default 30)")
    parser.add_argument("--noise", type=float, default=0.005, help="their standard deviation [m]; 0: all is seen")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--model", choices=MODELS, default="ours", help="of the ball, in the planner")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--out", type=Path, default=Path("build/balance"), help="folder of the paths")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table's figures, as docs/data has them")
    parser.add_argument("--draw", type=Path, metavar="PNG", help="draw earlier runs in OUT, and run nothing")
    args = parser.parse_args(arguments)
    if args.draw:
        draw(args.out, args.scene, args.draw)
        return
    overrides = ["engine.threads=1", *MODELS[args.model][1], *args.overrides]
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    with workers:
        seeds = range(args.seed, args.seed + args.runs)
        jobs: list[Future[Run]] = [workers.submit(balance, args.scene, seed, overrides, args) for seed in seeds]
        runs = []
        for job in jobs:
            runs.append(job.result())
            print(json.dumps(runs[-1].to_json()), flush=True)
    longest = max(len(run.path) for run in runs)
    paths = [np.pad(run.path, ((0, longest - len(run.path)), (0, 0)), constant_values=np.nan) for run in runs]
    args.out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(args.out / f"{file_name(args.scene, args.model)}.npz", paths=paths, dt=runs[0].dt)
    row = figures(args, runs)
    print(" | ".join(row))
    if args.json:
        put_rows(args.json, COLUMNS, [row], study="balance", arguments=arguments)
