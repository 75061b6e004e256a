#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A geometric planner against which to measure: OMPL plans a path for a disc among spheres, the plant then drives it.

The path is planned once, by Informed RRT* (Gammell et al. 2014) and OMPL's path simplification, in the plane, around
the obstacles grown by the disc's radius and a margin. The disc follows a point that runs ahead on the path, one of its
velocity controls always at its limit.

    python tools/baselines.py point_reach --seed 3

prints one JSON object, like ``warpmpc run --json``.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpmpc.scene.errors import SceneError
from warpmpc.scene.schema import DriveMode, ShapeKind

if TYPE_CHECKING:
    from warpmpc import Plant, Scene

MARGIN = 0.05
"""Space the path leaves between disc and spheres [m]."""
LOOKAHEAD = 0.2
"""How far ahead on the path the point lies that the disc makes for [m]."""
ROUNDS = 1000
"""Rounds of Informed RRT*."""
TOLERANCE = 0.01
"""Longest piece of a path that goes unchecked [m]."""


@dataclass(frozen=True)
class Disc:
    """The planar task of a scene."""

    radius: float
    """[m]"""
    circles: np.ndarray
    """Obstacles (x, y, radius) ``[n, 3]`` [m], not grown."""

    @classmethod
    def of(cls, plant: Plant) -> Disc:
        """Read the task off a plant.

        Raises:
            SceneError: If the scene is not a disc with velocity-driven x and y among spheres.
        """
        scene, layout = plant.scene, plant.layout
        solid = [s for s in layout.shapes if s.entity == scene.robot[0].name and s.collides]
        modes = {drive.mode for drive in scene.robot[0].drive}
        names = [name.split("/")[-1] for name in layout.control_name[:2]]
        planar = scene.goal.frame is not None and modes == {DriveMode.VELOCITY} and names == ["x", "y"]
        if not planar or [s.kind for s in solid] != ["cylinder"]:
            raise SceneError("the geometric baseline drives one disc by velocities x and y", file=scene.path)
        if other := [o.name for o in scene.obstacle if o.shape is not ShapeKind.SPHERE]:
            raise SceneError("the geometric baseline knows spheres only", file=scene.path, found=other[0])
        circles = [[*o.position[:2], o.size[0]] for o in scene.obstacle]
        return cls(solid[0].scale[0], np.array(circles, dtype=float).reshape(-1, 3))


def plan_path(disc: Disc, start: np.ndarray, goal: np.ndarray, *, seed: int) -> np.ndarray | None:
    """Corners of a short free path ``[n, 2]`` [m]; None when none was found.

    Args:
        disc: The task.
        start: (x, y) [m].
        goal: (x, y) [m].
        seed: The same seed gives the same path.

    Raises:
        ValueError: If OMPL is not installed.
    """
    try:
        from ompl import base, geometric, util
    except ImportError:
        raise ValueError("the geometric baseline needs OMPL: pip install ompl") from None
    util.setLogLevel(util.LOG_NONE)  # it complains of every seed after the first, which works nevertheless
    util.RNG.setSeed(seed + 1)
    grown = disc.circles[:, 2] + disc.radius + MARGIN
    # a start or goal closer than that is left as it is: the margin is a wish
    for end in (start, goal):
        grown = np.minimum(grown, np.maximum(np.hypot(*(disc.circles[:, :2] - end).T) - 1e-6, 0.0))
    circles = [(float(x), float(y), float(r) ** 2) for (x, y, _), r in zip(disc.circles, grown, strict=True)]

    space = base.RealVectorStateSpace(2)
    bounds = base.RealVectorBounds(2)
    corners = np.vstack([start, goal, disc.circles[:, :2] - grown[:, None], disc.circles[:, :2] + grown[:, None]])
    for axis, (low, high) in enumerate(zip(corners.min(0) - 1.0, corners.max(0) + 1.0, strict=True)):
        bounds.setLow(axis, float(low))
        bounds.setHigh(axis, float(high))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda p: all((p[0] - x) ** 2 + (p[1] - y) ** 2 >= r2 for x, y, r2 in circles))
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(TOLERANCE / space.getMaximumExtent())
    ends = []
    for place in (start, goal):
        state = space.allocState()
        state[0], state[1] = map(float, place)
        ends.append(state)
    setup.setStartAndGoalStates(*ends)
    setup.setOptimizationObjective(base.PathLengthOptimizationObjective(information))
    setup.setPlanner(geometric.InformedRRTstar(information))
    rounds = iter(range(ROUNDS))
    # rounds rather than seconds, so that a busy machine finds the same path
    setup.solve(base.PlannerTerminationCondition(lambda: next(rounds, None) is None))
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    setup.getPathSimplifier().simplifyMax(path)
    return np.array([(state[0], state[1]) for state in path.getStates()])


class Follower:
    """Velocities along a path, with the faster of x and y at its limit.

    Args:
        path: Corners ``[n, 2]`` [m].
        limit: Largest velocities ``[2]`` [m/s].
    """

    def __init__(self, path: np.ndarray, limit: np.ndarray):
        self.limit = limit
        length = np.hypot(*np.diff(path, axis=0).T)
        self._arc = np.concatenate([[0.0], np.cumsum(length)])
        self._at = np.arange(0.0, self._arc[-1] + TOLERANCE, TOLERANCE)
        self._points = np.column_stack([np.interp(self._at, self._arc, path[:, i]) for i in range(2)])
        self._nearest = 0

    def __call__(self, place: np.ndarray) -> np.ndarray:
        """Velocity ``[2]`` [m/s] at a place (x, y) [m]."""
        ahead = round(LOOKAHEAD / TOLERANCE)
        window = self._points[self._nearest : self._nearest + 2 * ahead]  # never back, never over to another stretch
        self._nearest += int(np.argmin(np.hypot(*(window - place).T)))
        way = self._points[min(self._nearest + ahead, len(self._points) - 1)] - place
        share = np.max(np.abs(way) / self.limit)
        return way / share if share > 1e-9 else np.zeros(2)


def run_geometric(scene: Scene, *, seed: int) -> dict:
    """Run one episode with the geometric planner.

    Args:
        scene: A disc among spheres.
        seed: Seed of the task, the path and the plant's properties.

    Returns:
        ``result``, ``measured`` and ``gpu``, as :func:`jobs.run_job` returns them; ``plan_ms`` is the one plan.

    Raises:
        SceneError: If the scene is not a disc among spheres, or no task can be drawn.
        ValueError: If OMPL is not installed.
    """
    from measure import Meter

    from warpmpc import EpisodeResult, Plant
    from warpmpc.model.compiled import compile_scene
    from warpmpc.run.episode import draws_bodies
    from warpmpc.scene.draw import draw_task

    scene, drawn = draw_task(scene, seed)
    plant = Plant(scene, seed=seed, compiled=compile_scene(scene, cache=not draws_bodies(scene)))
    disc, meter = Disc.of(plant), Meter(plant)
    start = time.perf_counter()
    path = plan_path(disc, meter.place[:2], plant.goal[:2].astype(float), seed=seed)
    plan_ms = 1e3 * (time.perf_counter() - start)
    control = np.zeros(plant.layout.nu, dtype=np.float32)
    follow = Follower(path, plant.layout.control_upper[:2]) if path is not None else None
    while follow and not plant.done:
        control[:2] = follow(meter.place[:2])
        plant.apply(control)
        meter(None, plant, control)
    result = EpisodeResult(
        scene=scene.name,
        variant=scene.variant,
        seed=seed,
        engine="ompl",
        device="cpu",
        success=plant.success,
        reason="no path found" if path is None else plant.reason,
        sim_time=plant.time,
        steps=plant.steps,
        position_error=plant.error.position,
        yaw_error=None,
        cost=math.nan,
        max_force=plant.contact.max_force,
        time_in_contact=plant.contact.time,
        plan_ms=dict.fromkeys(("p50", "p90", "p99", "max"), plan_ms),
        stages_ms={},
        diverged_worlds=0,
        samples=0,
        horizon=0,
        fallbacks=0,
        drawn=drawn,
    )
    return {"result": result.to_json(), "measured": meter.to_json(), "gpu": None}


def main() -> None:
    """Command line of this tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="point_reach")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    args = parser.parse_args()

    from warpmpc import load_scene
    from warpmpc.cli.setup import results_only, start_warp

    with results_only() as out:
        try:
            start_warp()
            run = run_geometric(load_scene(args.scene, overrides=args.overrides), seed=args.seed)
        except ValueError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(2)
        print(json.dumps({**run["result"], "measured": run["measured"]}, ensure_ascii=False), file=out)


if __name__ == "__main__":
    main()
