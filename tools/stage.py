# SPDX-License-Identifier: Apache-2.0
"""A scene's bodies on a lit stage, drawn by MuJoCo's offscreen renderer: no window, no graphics card needed.

Set ``MUJOCO_GL`` to ``osmesa`` (Debian: ``apt install libosmesa6``) or ``egl`` before this is imported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from warpmpc.controller.rollout_paths import BEST_COLOR
from warpmpc.model.layout import IDENTITY, WORLD
from warpmpc.record.recorder import CLOUD_COLOR
from warpmpc.record.scene_picture import triangles_of
from warpmpc.record.shapes import DEFAULT_COLOR, resized, shown_shapes, thinned

if TYPE_CHECKING:
    from warpmpc.controller.rollout_paths import RolloutPaths
    from warpmpc.model.layout import ShapeInfo
    from warpmpc.plant.plant import Plant

SIZE = (1120, 700)
"""Width and height of what is drawn [pixels]; files have half of it, for smooth edges."""
FIELD = np.radians(40.0)
"""Angle that the picture's height shows [rad]."""
BELOW = 0.006
"""How far below the ground it is drawn, so that what is level with it is seen [m]."""
GHOST = (0.25, 0.8, 0.4, 0.35)
"""Colour of the goal."""
COLORS = {"robot": (0.95, 0.62, 0.22), "object": (0.20, 0.50, 0.84), "obstacle": (0.58, 0.42, 0.40)}
"""Colours by kind, of all but robots' own visuals."""
TERRAIN = (0.62, 0.60, 0.52)
"""Colour of heightfields."""
KINDS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}
"""Shapes that MuJoCo draws itself; others become meshes."""


@dataclass(frozen=True)
class Look:
    """Where the camera is."""

    centre: np.ndarray
    """What it looks at ``[3]`` [m]."""
    distance: float
    """How far away it is [m]."""
    azimuth: float
    """From where, about the vertical [deg]."""
    elevation: float
    """From how high, negative from above [deg]."""


@dataclass(frozen=True)
class Moment:
    """What is on the stage at a moment."""

    time: float
    """Simulated time [s]."""
    body_q: np.ndarray
    """Poses of bodies ``[nb, 7]``."""
    poses: dict[str, np.ndarray]
    """Poses ``[7]`` of the goal and of movable obstacles by name."""
    paths: RolloutPaths | None
    """Paths of rollouts."""


class Stage:
    """Draws moments of a plant's scene.

    Args:
        plant: The plant.
        floor: Height of the floor where the scene has no ground [m].
        look: From where most of it is seen.
        plain: Whether robots have one colour whatever their assets say.
    """

    def __init__(self, plant: Plant, *, floor: float, look: Look, plain: bool = False):
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
        self.model = spec.compile()
        self._data = mujoco.MjData(self.model)
        self._renderer = mujoco.Renderer(self.model, SIZE[1], SIZE[0], max_geom=20000)

    def close(self) -> None:
        """Free what the renderer holds."""
        self._renderer.close()

    def picture(self, moment: Moment, look: Look) -> np.ndarray:
        """A moment as an image ``[height, width, 3]``."""
        data, model = self._data, self.model
        for name, shown in self._moving:
            pose = moment.body_q[shown] if isinstance(shown, int) else moment.poses[shown]
            i = model.body(name).mocapid[0]
            data.mocap_pos[i], data.mocap_quat[i] = pose[:3], np.roll(pose[3:], 1)
        mujoco.mj_forward(model, data)
        camera = mujoco.MjvCamera()
        camera.lookat[:], camera.distance = look.centre, look.distance
        camera.azimuth, camera.elevation = look.azimuth, look.elevation
        self._renderer.update_scene(data, camera)
        if moment.paths is not None:
            for path, color in zip(moment.paths.others, moment.paths.colors, strict=True):
                self._lines(path, (*(color / 255.0), 0.7), mujoco.mjtGeom.mjGEOM_LINE, 2.0)
            best = (*np.array(BEST_COLOR) / 255.0, 1.0)
            self._lines(moment.paths.best, best, mujoco.mjtGeom.mjGEOM_CAPSULE, self._thick)
        self._points()
        return self._renderer.render()

    def _dress(self, spec: mujoco.MjSpec, floor: float, look: Look) -> None:
        """Sky, floor, lights; shadows are as fine as what is seen is small."""
        spec.stat.extent = look.distance
        spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
        spec.visual.global_.fovy = np.degrees(FIELD)
        spec.visual.quality.shadowsize, spec.visual.quality.offsamples = (
            2048,
            0,
        )  # much takes long without a graphics card
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
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(type=plane, size=[0, 0, 1], pos=[0, 0, height - BELOW], material="floor")
        for place, shadow, strength in (((3, -4, 8), True, 0.45), ((-5, 3, 6), False, 0.15)):
            direction = -np.array(place) / np.linalg.norm(place)
            light = spec.worldbody.add_light(pos=look.centre - look.distance * direction, dir=direction)
            light.castshadow = shadow
            light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
            light.diffuse, light.specular, light.ambient = [strength] * 3, [0.2] * 3, [0.0] * 3

    def _add_body(self, spec: mujoco.MjSpec, name: str, shown: int | str) -> mujoco.MjsBody:
        """A body that goes where a body or pose of the scene is."""
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
            turn = np.zeros(4)
            mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
            keys = {"pos": data.geom_xpos[geom], "quat": turn, "contype": 0, "conaffinity": 0}
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
            size = [4.0 * self._thick, 0.0, 0.0]
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, rgba=(*GHOST[:3], 0.6), contype=0, conaffinity=0
            )
            return
        back = wp.transform_inverse(wp.transform(*layout.frame_pose[frame].tolist()))
        entity = next(entity for entity in layout.entities if moving in entity.bodies)
        for shape in shown_shapes(layout, entity):
            if shape.body == moving:
                placed = back * wp.transform(*shape.pose)
                self._add(spec, body, replace(shape, pose=tuple(placed)), GHOST, tuple(placed))

    def _add(
        self, spec: mujoco.MjSpec, body: mujoco.MjsBody, shape: ShapeInfo, rgba: Sequence[float], pose: Sequence[float]
    ) -> None:
        """Add a shape to a body of the drawing."""
        keys = {"rgba": rgba, "contype": 0, "conaffinity": 0, "mass": 0.0, "material": "body"}
        pose = np.asarray(pose, dtype=float)
        place = {"pos": pose[:3], "quat": np.roll(pose[3:], 1)}
        if shape.kind in KINDS:
            body.add_geom(type=KINDS[shape.kind], size=np.array(shape.scale, dtype=float), **place, **keys)
            return
        if shape.kind == "mesh" and shape.mesh is not None:
            points, faces = self._layout.meshes[shape.mesh]
            points, faces = np.asarray(points) * np.array(shape.scale), np.asarray(faces).reshape(-1, 3)
        else:
            local = triangles_of(shape, self._layout, hull=False)  # in the body's frame
            if not len(local):
                return
            points, faces = local.reshape(-1, 3), np.arange(3 * len(local)).reshape(-1, 3)
            place = {}
        name = f"mesh_{len(spec.meshes)}"
        mesh = spec.add_mesh(name=name, uservert=points.ravel(), userface=faces.ravel().astype(int))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # visual meshes may be open or flat
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **place, **keys)

    def _lines(self, paths: np.ndarray, rgba: Sequence[float], kind: mujoco.mjtGeom, thick: float) -> None:
        """Draw paths ``[F, T+1, 3]`` as capsules of a radius [m] or lines of a width [pixels]."""
        for path in paths:
            for start, end in pairwise(path):
                if not np.isfinite([start, end]).all() or np.linalg.norm(end - start) < 1e-5:
                    continue
                geom = self._geom(kind, rgba)
                if geom is None:
                    return
                mujoco.mjv_connector(geom, kind, thick, start.astype(float), end.astype(float))

    def _points(self) -> None:
        """Draw what clouds have seen."""
        for cloud in self._plant.scene.cloud:
            for point in thinned(self._plant.task.points(cloud.name), cloud):
                geom = self._geom(mujoco.mjtGeom.mjGEOM_BOX, (*np.array(CLOUD_COLOR) / 255.0, 1.0))
                if geom is None:
                    return
                geom.pos[:], geom.size[:] = point, 0.3 * cloud.voxel

    def _geom(self, kind: mujoco.mjtGeom, rgba: Sequence[float]) -> mujoco.MjvGeom | None:
        """A new shape that belongs to no body; None when there are too many."""
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return None
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.array(rgba, dtype=np.float32))
        scene.ngeom += 1
        return geom
