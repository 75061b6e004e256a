# SPDX-License-Identifier: Apache-2.0
"""What the plant did in an episode, measured step by step: path, smoothness, clearance, errors at start and end."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from warpmpc.scene.model.mjcf_mocap import movable_body

if TYPE_CHECKING:
    from warpmpc import Controller, Plant
    from warpmpc.scene.model.compiled import CompiledScene

AFTER = 8.0
"""When errors are noted besides [s]."""
FAR = 1e3
"""Distances beyond this count as this [m]."""


class Clearance:
    """Distance between the surfaces of robots and obstacles, planes left out.

    Shapes have their nominal sizes; meshes are their convex hulls, as in the plant's own collisions.

    Args:
        compiled: The compiled scene of the plant.
    """

    def __init__(self, compiled: CompiledScene):
        self.model = compiled.spec().compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)  # poses of whatever is fixed to the world
        layout = compiled.layout
        kind = {entity.name: entity.kind for entity in layout.entities}
        solid: dict[str, list[tuple[int, int]]] = {"robot": [], "obstacle": []}
        for shape, name in zip(layout.shapes, compiled.geom_name, strict=True):
            if name and shape.kind != "plane" and kind[shape.entity] in solid:
                solid[kind[shape.entity]].append((self.model.geom(name).id, shape.body))
        self.robot, self.obstacle = solid["robot"], solid["obstacle"]

    def of(self, plant: Plant) -> float:
        """The least distance [m] in a plant, obstacles that move where they are."""
        for name in plant.layout.movable:
            mocap, pose = self.model.body(movable_body(name)).mocapid[0], plant.pose(name)
            self.data.mocap_pos[mocap], self.data.mocap_quat[mocap] = pose[:3], pose[[6, 3, 4, 5]]
        if plant.layout.movable:
            mujoco.mj_kinematics(self.model, self.data)
        return self(plant.body_q)

    def __call__(self, body_q: np.ndarray) -> float:
        """The least distance [m] at body poses ``[nb, 7]``: below zero where they overlap, infinite without a pair."""
        if not self.robot or not np.isfinite(body_q).all():
            return math.inf
        for geom, body in (*self.robot, *self.obstacle):
            if body >= 0:
                self._place(geom, body_q[body])
        pairs = ((robot, obstacle) for robot, _ in self.robot for obstacle, _ in self.obstacle)
        distances = (mujoco.mj_geomDistance(self.model, self.data, *pair, FAR, None) for pair in pairs)
        return min(distances, default=math.inf)

    def _place(self, geom: int, pose: np.ndarray) -> None:
        """Put a geom where its body is."""
        turn = Rotation.from_quat(pose[3:])
        w, *xyz = self.model.geom_quat[geom]
        self.data.geom_xpos[geom] = pose[:3] + turn.apply(self.model.geom_pos[geom])
        self.data.geom_xmat[geom] = (turn * Rotation.from_quat([*xyz, w])).as_matrix().ravel()


class Meter:
    """Measures an episode; hand it to :meth:`warpmpc.loop.run.episode.Episode.run` as ``on_step``.

    In a scene without a goal there is nothing whose way and errors could be measured: they are ``None``.

    Args:
        plant: The episode's plant, before its first step.
    """

    def __init__(self, plant: Plant):
        self.plant = plant
        self._goal = plant.scene.goal is not None
        if self._goal:
            frame = plant.layout.frame(plant.scene.goal.target)
            self._body, self._offset = int(plant.layout.frame_body[frame]), plant.layout.frame_pose[frame][:3]
            self.place = self._goal_target()
        self._start = self._then = plant.error
        self.path_length = 0.0
        self.squared_jerk = 0.0
        """∫ ‖p⃛‖² dt of the goal's frame or object [m²/s⁵], from differences of its place after every control."""
        self.squared_control_rate = 0.0
        """∫ ‖u̇‖² dt, from differences of consecutive controls: of accelerations, the squared jerk that is asked for."""
        self._last = [self.place] if self._goal else []  # places, four at most
        self._control: np.ndarray | None = None
        self._clearance = Clearance(plant.compiled) if plant.scene.obstacle else None
        self.clearance = self._clearance.of(plant) if self._clearance else math.inf

    def __call__(self, controller: Controller | None, plant: Plant, control: np.ndarray) -> None:
        """Take note of the step just made."""
        dt = plant.scene.timing.control_dt
        if self._control is not None:
            self.squared_control_rate += float(np.sum((control - self._control) ** 2)) / dt
        self._control = np.array(control, dtype=float)
        if self._goal:
            if plant.time <= AFTER + 1e-6:
                self._then = plant.error
            at = self._goal_target()
            self.path_length += float(np.linalg.norm(at - self.place))
            self.place = at
            self._last = [*self._last[-3:], at]
            if len(self._last) == 4:
                jerk = np.diff(np.array(self._last, dtype=float), 3, axis=0) / dt**3
                self.squared_jerk += dt * float(np.sum(jerk**2))
        if self._clearance:
            self.clearance = min(self.clearance, self._clearance.of(plant))

    def _goal_target(self) -> np.ndarray:
        """Where the frame or object is that shall reach the goal ``[3]`` [m]."""
        pose = self.plant.body_q[self._body]
        return pose[:3] + Rotation.from_quat(pose[3:]).apply(self._offset)

    def to_json(self) -> dict[str, object]:
        """The measures as data for JSON, ``None`` for what is not finite; units in the keys."""
        start, then, end, clearance = self._start, self._then, self.plant.error, _number(self.clearance)
        if not self._goal:
            of_goal = ("path_length_m", "squared_jerk_m2_s5", "start_position_error_m", "axes_error_m", "then_m_rad")
            rest = {"squared_control_rate": self.squared_control_rate, "clearance_m": clearance}
            return {**dict.fromkeys((*of_goal, "rotation_error_rad")), **rest}
        return {
            "path_length_m": _number(self.path_length),
            "squared_jerk_m2_s5": _number(self.squared_jerk),
            "squared_control_rate": self.squared_control_rate,
            "clearance_m": clearance,
            "start_position_error_m": _number(start.position),
            "axes_error_m": [_number(value) for value in end.axes],
            "rotation_error_rad": _number(end.rotation),
            "then_m_rad": [_number(value) for value in (*then.axes[:2], then.yaw)],
        }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
