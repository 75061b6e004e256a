#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Run shipped scenes and draw them with MuJoCo's renderer: a short animation of each, from one real run.

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
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp
from PIL import Image

import warpmpc
from warpmpc.cli.setup import start_warp
from warpmpc.extras.live.foresight import ShownRollouts
from warpmpc.extras.record.recorder import CLOUD_COLOR
from warpmpc.extras.record.shapes import DEFAULT_COLOR, box_of, mesh_of, resized, rotate, shown_shapes, thinned
from warpmpc.loop.run.episode import Episode
from warpmpc.planner.controller.rollout_paths import BEST_COLOR
from warpmpc.scene.load import shipped_scenes
from warpmpc.scene.model.layout import IDENTITY, WORLD

if TYPE_CHECKING:
    from warpmpc import Plant
    from warpmpc.planner.controller.rollout_paths import RolloutPaths
    from warpmpc.scene.model.layout import ShapeInfo

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
SIZE = (1120, 700)
"""Width and height of what is drawn [pixels]; files have half of it, for smooth edges."""
FIELD = np.radians(40.0)
"""Angle that the picture's height shows [rad]."""
GHOST, TERRAIN = (0.25, 0.8, 0.4, 0.35), (0.62, 0.60, 0.52)
COLORS = {"robot": (0.95, 0.62, 0.22), "object": (0.20, 0.50, 0.84), "obstacle": (0.58, 0.42, 0.40)}
"""Colours of the goal, of heightfields, and by kind of all but robots' visuals."""


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
    """Whether the robot has one colour, for assets whose shapes have none."""
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


@dataclass(frozen=True)
class Moment:
    """What is on the stage at a moment."""

    body_q: np.ndarray
    """Poses of bodies ``[nb, 7]``."""
    poses: dict[str, np.ndarray]
    """Poses ``[7]`` of the goal and of movable obstacles by name."""
    paths: RolloutPaths | None
    """Paths of rollouts."""


class Stage:
    """Draws moments of a plant's scene; the floor is at a height [m] where the scene has no ground."""

    def __init__(self, plant: Plant, *, floor: float, look: mujoco.MjvCamera, plain: bool = False):
        self._plant, self._layout, self._thick = plant, plant.layout, 0.003 * look.distance
        spec = mujoco.MjSpec()
        self._dress(spec, floor, look)
        self._moving: list[tuple[str, int | str]] = []  # body of the drawing, and body or pose that it shows
        bodies = [self._add_body(spec, f"body_{b}", b) for b in range(self._layout.nb)]
        for entity in self._layout.entities:
            parent = self._add_body(spec, f"movable_{entity.name}", entity.name) if entity.movable else None
            for shape in shown_shapes(self._layout, entity):
                if shape.kind == "plane":
                    continue
                own = shape.color if entity.kind == "robot" and shape.visible and not plain else None
                color = own or COLORS.get(entity.kind, DEFAULT_COLOR)
                if entity.kind != "robot":
                    shape = resized(shape, plant.properties)
                at = spec.worldbody if shape.body == WORLD else bodies[shape.body]
                self._add(spec, parent or at, shape, (*color[:3], 1.0), IDENTITY if entity.movable else shape.pose)
        self._add_terrain(spec)
        self._add_goal(spec)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self.renderer = mujoco.Renderer(self._model, SIZE[1], SIZE[0], max_geom=100000)

    def picture(self, moment: Moment, look: mujoco.MjvCamera) -> np.ndarray:
        """A moment as an image ``[height, width, 3]``."""
        data, model = self._data, self._model
        for name, shown in self._moving:
            pose = moment.body_q[shown] if isinstance(shown, int) else moment.poses[shown]
            i = model.body(name).mocapid[0]
            data.mocap_pos[i], data.mocap_quat[i] = pose[:3], np.roll(pose[3:], 1)
        mujoco.mj_forward(model, data)
        self.renderer.update_scene(data, look)
        if moment.paths is not None:
            for path, color in zip(moment.paths.others, moment.paths.colors, strict=True):
                self._lines(path, (*(color / 255.0), 0.7), mujoco.mjtGeom.mjGEOM_LINE, 2.0)
            best = (*np.array(BEST_COLOR) / 255.0, 1.0)
            self._lines(moment.paths.best, best, mujoco.mjtGeom.mjGEOM_CAPSULE, self._thick)
        self._points()
        return self.renderer.render()

    def _dress(self, spec: mujoco.MjSpec, floor: float, look: mujoco.MjvCamera) -> None:
        """Sky, floor, lights; shadows are as fine as what is seen is small."""
        spec.stat.extent = look.distance
        spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
        spec.visual.global_.fovy = np.degrees(FIELD)
        spec.visual.quality.shadowsize, spec.visual.quality.offsamples = 2048, 0  # quick without a graphics card
        spec.visual.quality.numslices, spec.visual.quality.numstacks = 20, 12
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.30] * 3, [0.30] * 3
        spec.visual.headlight.specular = [0.0] * 3
        spec.visual.map.znear, spec.visual.map.zfar, spec.visual.map.shadowclip = 0.01, 100.0, 1.5
        sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT}
        spec.add_texture(name="sky", **sky, rgb1=[0.93, 0.95, 0.98], rgb2=[0.70, 0.78, 0.88], width=64, height=384)
        squares = {"type": mujoco.mjtTexture.mjTEXTURE_2D, "builtin": mujoco.mjtBuiltin.mjBUILTIN_CHECKER}
        edge = {"mark": mujoco.mjtMark.mjMARK_EDGE, "markrgb": [0.56, 0.59, 0.63]}
        shades = {"rgb1": [0.72, 0.74, 0.77], "rgb2": [0.66, 0.69, 0.72]}
        spec.add_texture(name="squares", **squares, **edge, **shades, width=256, height=256)
        floor_material = spec.add_material(name="floor", texrepeat=[2, 2], texuniform=True)
        floor_material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "squares"
        spec.add_material(name="body", specular=0.35, shininess=0.4)
        ground = self._plant.scene.ground
        height = floor if ground is None else ground.height
        keys = {"size": [0, 0, 1], "pos": [0, 0, height - 0.006], "material": "floor"}
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, **keys)
        for place, shadow, strength in (((3, -4, 8), True, 0.45), ((-5, 3, 6), False, 0.15)):
            direction = -np.array(place) / np.linalg.norm(place)
            light = spec.worldbody.add_light(pos=look.lookat - look.distance * direction, dir=direction)
            light.castshadow = shadow
            light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
            light.diffuse, light.specular, light.ambient = [strength] * 3, [0.2] * 3, [0.0] * 3

    def _add_body(self, spec: mujoco.MjSpec, name: str, shown: int | str) -> mujoco.MjsBody:
        self._moving.append((name, shown))
        return spec.worldbody.add_body(name=name, mocap=True)

    def _add_terrain(self, spec: mujoco.MjSpec) -> None:
        """Heightfields that stand still, which are no shapes of the layout."""
        model = self._plant.compiled.spec().compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD):
            i = model.geom_dataid[geom]
            rows, columns, first = model.hfield_nrow[i], model.hfield_ncol[i], model.hfield_adr[i]
            heights = model.hfield_data[first : first + rows * columns]
            name = f"heights_{geom}"
            spec.add_hfield(name=name, size=model.hfield_size[i], nrow=rows, ncol=columns, userdata=heights)
            keys = {"pos": data.geom_xpos[geom], "quat": np.zeros(4), "contype": 0, "conaffinity": 0}
            mujoco.mju_mat2Quat(keys["quat"], data.geom_xmat[geom])
            field = mujoco.mjtGeom.mjGEOM_HFIELD
            spec.worldbody.add_geom(type=field, hfieldname=name, rgba=(*TERRAIN, 1.0), **keys)

    def _add_goal(self, spec: mujoco.MjSpec) -> None:
        """What shall be at the goal as a ghost where it has a heading, else a ball."""
        goal, layout = self._plant.scene.goal, self._layout
        if goal is None:
            return
        body = self._add_body(spec, "the goal", "goal")
        frame = layout.frame(goal.target)
        moving = int(layout.frame_body[frame])
        if moving < 0 or (goal.yaw is None and goal.rotation is None and goal.object is None):
            keys = {"size": [4.0 * self._thick, 0.0, 0.0], "rgba": (*GHOST[:3], 0.6), "contype": 0, "conaffinity": 0}
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, **keys)
            return
        back = wp.transform_inverse(wp.transform(*layout.frame_pose[frame].tolist()))
        entity = next(entity for entity in layout.entities if moving in entity.bodies)
        for shape in shown_shapes(layout, entity):
            if shape.body == moving:
                self._add(spec, body, shape, GHOST, tuple(back * wp.transform(*shape.pose)))

    def _add(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, shape: ShapeInfo, rgba: tuple, pose: tuple) -> None:
        """Add a shape to a body of the drawing."""
        keys = {"rgba": rgba, "contype": 0, "conaffinity": 0, "mass": 0.0, "material": "body"}
        if (mesh := mesh_of(shape, self._layout)) is None:
            return
        name = f"mesh_{len(spec.meshes)}"
        form = spec.add_mesh(name=name, uservert=mesh.vertices.ravel(), userface=mesh.faces.ravel().astype(int))
        form.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # visual meshes may be open or flat
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=pose[:3], quat=np.roll(pose[3:], 1), **keys)

    def _lines(self, paths: np.ndarray, rgba: tuple, kind: mujoco.mjtGeom, thick: float) -> None:
        """Draw paths ``[F, T+1, 3]`` as capsules of a radius [m] or lines of a width [pixels]."""
        for start, end in (ends for path in paths for ends in itertools.pairwise(path)):
            if np.isfinite([start, end]).all() and np.linalg.norm(end - start) >= 1e-5:
                mujoco.mjv_connector(self._geom(kind, rgba), kind, thick, start.astype(float), end.astype(float))

    def _points(self) -> None:
        """Draw what clouds have seen."""
        for cloud in self._plant.scene.cloud:
            for point in thinned(self._plant.task.points(cloud.name), cloud):
                geom = self._geom(mujoco.mjtGeom.mjGEOM_BOX, (*np.array(CLOUD_COLOR) / 255.0, 1.0))
                geom.pos[:], geom.size[:] = point, 0.3 * cloud.voxel

    def _geom(self, kind: mujoco.mjtGeom, rgba: tuple) -> mujoco.MjvGeom:
        """A new shape that belongs to no body."""
        scene = self.renderer.scene
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.array(rgba, dtype=np.float32))
        scene.ngeom += 1
        return geom


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
        moments.append(Moment(plant.body_q.copy(), poses, rollouts.paths))
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


def framed(points: np.ndarray, shot: Shot) -> mujoco.MjvCamera:
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
    look = mujoco.MjvCamera()
    look.lookat[:], look.distance = centre, MARGIN * float(distance) / shot.closer
    look.azimuth, look.elevation = shot.azimuth, shot.elevation
    return look


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
        look.distance = whole.distance
        drawn = Image.fromarray(stage.picture(moment, look))
        return drawn.resize((width, width * SIZE[1] // SIZE[0]), Image.Resampling.LANCZOS)

    folder.mkdir(parents=True, exist_ok=True)
    pictures = [image(moment, WIDTH) for moment in frames]
    stage.renderer.close()
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
