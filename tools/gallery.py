#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Run shipped scenes and draw them: a short animation of each, from one real run.

    MUJOCO_GL=osmesa python tools/gallery.py                     # every scene, into docs/gallery
    MUJOCO_GL=egl python tools/gallery.py push_t pendulum --out /tmp/gallery
    python tools/gallery.py --page                               # writes docs/gallery.md alone

Red is the way of the best rollout, thin lines are others, the cheaper the lighter; green is the goal. Runs that take
longer than --wall are drawn as far as they came. Exit code 2 for bad input.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from stage import FIELD, SIZE, Look, Moment, Stage

import warpmpc
from warpmpc.cli.setup import start_warp
from warpmpc.live.rollouts import ShownRollouts
from warpmpc.record.shapes import box_of, rotate
from warpmpc.run.episode import Episode
from warpmpc.scene.load import shipped_scenes

if TYPE_CHECKING:
    from warpmpc import Plant

PAGE = Path(__file__).parents[1] / "docs/gallery.md"
FRAMES, SHOWN = 40, 4.0
"""Frames of an animation at most, and how long it lasts [s]."""
WIDTH = 420
"""Of an animation [pixels]."""
LARGEST = 550_000
"""Bytes of an animation: quality goes down until it fits."""
LARGE = 1.2
"""Half the length of obstacles that need not be seen whole [m]."""
MARGIN = 1.06
"""Room at the edges of a picture."""
HOLD = 0.9
"""How long the last frame of an animation stays [s]."""


@dataclass(frozen=True)
class Shot:
    """How a scene is shown."""

    azimuth: float = 130.0
    elevation: float = -28.0
    closer: float = 1.0
    """Nearer than what shows all, for scenes with much around."""
    follow: bool = False
    """Whether the camera goes along with the robot."""
    plain: bool = False
    """Whether the robot has one colour, for assets whose shapes have none of their own."""
    longest: float = 20.0
    """What is shown of a run at most [s]."""


SHOTS = {
    "acrobot": Shot(azimuth=90.0, elevation=-8.0),
    "box_carry": Shot(azimuth=130.0, elevation=-16.0, plain=True, closer=1.15),
    "cartpole_swingup": Shot(azimuth=90.0, elevation=-8.0),
    "panda_reach": Shot(plain=True),
    "push_t": Shot(closer=0.85),
    "quadrotor": Shot(follow=True, closer=1.7),
    "storm_cloud": Shot(azimuth=35.0, closer=1.15),
    "pendulum": Shot(azimuth=90.0, elevation=-8.0),
    "g1_walk": Shot(azimuth=110.0, elevation=-10.0, follow=True, longest=5.0),
    "go2_jump": Shot(azimuth=150.0, elevation=-14.0, longest=1.2),
    "go2_walk": Shot(azimuth=110.0, elevation=-14.0, follow=True, longest=3.0),
    "hand_cube": Shot(azimuth=75.0, elevation=-50.0, closer=1.15, longest=4.0),
    "humanoid_stand": Shot(longest=4.0),
    "humanoid_get_up": Shot(longest=4.0),
    "quadruped_walk": Shot(follow=True, longest=6.0),
    "quadruped_terrain": Shot(follow=True, longest=6.0),
    "walker": Shot(azimuth=90.0, elevation=-6.0, follow=True, longest=3.0),
}


def record(name: str, *, engine: str, wall: float) -> tuple[Plant, list[Moment], str]:
    """Run a scene's first episode; returns the plant, what was on the stage at each control, and how it ended."""
    episode = Episode(warpmpc.load_scene(name), seed=0, engine=engine, device="cpu")
    controller, plant, moments = episode.controller, episode.plant, []
    shot, start = SHOTS.get(name, Shot()), time.monotonic()

    rollouts = ShownRollouts(controller)

    class Enough(Exception):
        """The run is long enough."""

    def on_step(*_: object) -> None:
        poses = {pose: controller.task.pose(pose).copy() for pose in controller.task.pose_name}
        rollouts.clear() if controller.info.fallback else rollouts.update()
        moments.append(Moment(plant.time, plant.body_q.copy(), poses, rollouts.paths))
        if plant.time >= shot.longest or time.monotonic() - start > wall:
            raise Enough

    try:
        episode.run(on_step=on_step)
    except Enough:
        return plant, moments, "stopped"
    return plant, moments, plant.reason


def corners(plant: Plant, moment: Moment) -> np.ndarray:
    """Corners ``[n, 3]`` of the boxes around what the camera is to show: what moves and what is not too large."""
    found, layout = [], plant.layout
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    movable = {entity.name for entity in layout.entities if entity.movable}
    for shape in layout.shapes:
        centre, half = box_of(shape, layout)
        if not np.isfinite(half).all() or (shape.body < 0 and np.max(half) > LARGE):
            continue
        pose = np.array(moment.poses[shape.entity] if shape.entity in movable else shape.pose, dtype=float)
        at = pose[:3] + rotate(pose[3:], centre + signs * half)
        if shape.body >= 0:
            body = moment.body_q[shape.body].astype(float)
            at = body[:3] + rotate(body[3:], at)
        found.append(at)
    if plant.scene.goal is not None:
        found.append(moment.poses["goal"][None, :3])
    return np.concatenate(found)


def framed(points: np.ndarray, shot: Shot) -> Look:
    """The camera that sees all points ``[n, 3]``."""
    azimuth, elevation = np.radians([shot.azimuth, shot.elevation])
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    up = np.cross(right, ahead)
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    sides = np.stack([(points - centre) @ right, (points - centre) @ up], axis=1)
    centre = centre + 0.5 * (sides.min(axis=0) + sides.max(axis=0)) @ np.stack([right, up])  # to the picture's middle
    x, y, z = (points - centre) @ right, (points - centre) @ up, (points - centre) @ ahead
    slope = np.tan(0.5 * FIELD)
    distance = np.max(np.maximum(np.abs(y), np.abs(x) * SIZE[1] / SIZE[0]) / slope - z)
    return Look(centre, MARGIN * float(distance) / shot.closer, shot.azimuth, shot.elevation)


def draw(name: str, folder: Path, *, engine: str, wall: float) -> str:
    """Run and draw a scene; returns a line about it."""
    plant, moments, end = record(name, engine=engine, wall=wall)
    shot = SHOTS.get(name, Shot())
    chosen = np.unique(np.linspace(0, len(moments) - 1, min(FRAMES, len(moments))).astype(int))
    frames = [moments[i] for i in chosen]
    floor = min(float(corners(plant, moment)[:, 2].min()) for moment in frames)
    whole = framed(
        np.concatenate([corners(plant, moment) for moment in frames[:: 1 + len(frames) * shot.follow]]), shot
    )
    stage = Stage(plant, floor=floor, look=whole, plain=shot.plain)

    def image(moment: Moment, width: int) -> Image.Image:
        look = framed(corners(plant, moment), shot) if shot.follow else whole
        drawn = Image.fromarray(stage.picture(moment, replace(look, distance=whole.distance)))
        return drawn.resize((width, width * SIZE[1] // SIZE[0]), Image.Resampling.LANCZOS)

    folder.mkdir(parents=True, exist_ok=True)
    pictures = [image(moment, WIDTH) for moment in frames]
    stage.close()
    size = animate(pictures, folder / f"{name}.webp")
    return f"{name}: {end}, {plant.time:.1f} s of {len(moments)} controls, {size // 1000} kB"


def animate(pictures: list[Image.Image], path: Path) -> int:
    """Write an animation that is small enough; returns its size in bytes."""
    each = int(1000 * SHOWN / len(pictures))
    durations = [each] * (len(pictures) - 1) + [each + int(1000 * HOLD)]
    for quality in (70, 55, 40, 25, 15):
        pictures[0].save(
            path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, quality=quality, method=4
        )
        if path.stat().st_size <= LARGEST:
            break
    return path.stat().st_size


def page() -> str:
    """The page that shows all scenes."""
    parts = [
        "# Gallery\n",
        "Every scene that ships, from a real run of its seed 0, drawn by `tools/gallery.py`. Red is the way of the\n"
        "best rollout, thin lines are others, the lighter the cheaper; green is the goal. An animation takes four\n"
        "seconds, however long its run took; some runs went on after it. `warpmpc run SCENE` plays one.\n",
    ]
    for name in shipped_scenes():
        title = warpmpc.load_scene(name).title
        parts.append(f"## {name}\n\n{title}.\n\n![{name}](gallery/{name}.webp)\n")
    return "\n".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Command line of this tool; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="shipped scenes; all of them when left out")
    parser.add_argument("--engine", default="auto", help="engine of the rollouts")
    parser.add_argument("--wall", type=float, default=150.0, help="wall time of a run [s] (default 150)")
    parser.add_argument("--page", action="store_true", help="write docs/gallery.md and draw nothing")
    parser.add_argument("--out", type=Path, default=PAGE.with_suffix(""), help="folder (default docs/gallery)")
    args = parser.parse_args(arguments)
    if args.page:
        PAGE.write_text(page(), encoding="utf-8")
        return 0
    if "MUJOCO_GL" not in os.environ:
        parser.error("set MUJOCO_GL to osmesa or egl: there is no window to draw in")
    start_warp()
    try:
        for name in args.scenes or shipped_scenes():
            print(draw(name, args.out, engine=args.engine, wall=args.wall), flush=True)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
