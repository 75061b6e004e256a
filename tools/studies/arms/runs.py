# SPDX-License-Identifier: Apache-2.0
"""The closed loop to one pose: what is measured, and the worker that keeps a controller from pose to pose."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from .arm import Arm
from .osc import FASTEST, PERIOD, OperationalSpace, with_torques
from .poses import Reachable, draw_pose
from .reference import fastest

if TYPE_CHECKING:
    from warpmpc import Controller, Plant, State

HOLD = 0.5
"""How long a pose must be held to count as reached [s]."""


class Pilot(Protocol):
    """What drives the arm."""

    def begin(self, target: Reachable, *, seed: int) -> None:
        """Take a new pose; the arm is at its start."""

    def step(self, state: State) -> np.ndarray:
        """Control ``[nu]`` for an observed state."""


class Planner:
    """The scene's own planner.

    Args:
        controller: The controller; its task is the plant's.
    """

    def __init__(self, controller: Controller):
        self.controller = controller

    def begin(self, target: Reachable, *, seed: int) -> None:
        """Forget all plans and go for a pose."""
        self.controller.reset()
        self.controller.task["goal"] = target.pose

    def step(self, state: State) -> np.ndarray:
        """Plan."""
        return self.controller.step(state)


class Torques:
    """Operational-space control.

    Args:
        plant: A plant that takes torques.
    """

    def __init__(self, plant: Plant):
        self._law, self._task = OperationalSpace(plant, fastest=FASTEST), plant.task

    def begin(self, target: Reachable, *, seed: int) -> None:
        """Nothing to forget: the goal is the task's."""

    def step(self, state: State) -> np.ndarray:
        """Torques for the plant as it is."""
        return self._law(self._task["goal"])


@dataclass
class Track:
    """What an arm did on its way to one pose."""

    miss: list[tuple[float, float]] = field(default_factory=list)
    """Distance [m] and angle [rad] from the pose after every control."""
    q: list[np.ndarray] = field(default_factory=list)
    qd: list[np.ndarray] = field(default_factory=list)
    plan_ms: list[float] = field(default_factory=list)
    touched: set[str] = field(default_factory=set)
    """What overlapped, of the arm's own links at the ends of the controls, or pushed at any physics step."""


class Course:
    """A plant, its arm and the way things are judged.

    Args:
        plant: The plant.
        every: Controls from one look at the arm to the next.
    """

    def __init__(self, plant: Plant, *, every: int = 1):
        self.plant, self.arm, self._every = plant, Arm(plant.scene, plant.compiled), every
        self._dt, self._success = every * plant.scene.timing.control_dt, plant.scene.success

    def run(self, pilot: Pilot, target: Reachable, *, seed: int = 0) -> tuple[dict, Track]:
        """Drive to a pose until it has been held, or time is out; returns what is reported, and the way."""
        plant, arm, track = self.plant, self.arm, Track()
        plant.reset()
        plant.task["goal"] = target.pose
        pilot.begin(target, seed=seed)
        held, wanted = 0, round(HOLD / self._dt)
        track.qd.append(plant.state.joint_qd[arm.dofs].astype(float))
        while held < wanted and plant.time < plant.scene.timing.timeout - 1e-9 and not plant.diverged:
            for _ in range(self._every):
                state, before = plant.observe(), time.perf_counter()
                control = pilot.step(state)
                track.plan_ms.append(1e3 * (time.perf_counter() - before))
                plant.apply(control)
            state = plant.state
            q = state.joint_q[arm.dofs].astype(float)
            track.q.append(q)
            track.qd.append(state.joint_qd[arm.dofs].astype(float))
            track.miss.append(pose_miss(arm.tool(q), target.pose))
            track.touched |= {"-".join(pair) for pair in arm.touching(q)}
            near, turned = track.miss[-1]
            held = held + 1 if near <= self._success.distance and turned <= self._success.rotation else 0
        track.touched |= {name for name, force in plant.contact.forces.items() if force > 0.0}
        reached = held >= wanted
        return {"reached": reached, "time_s": plant.time - HOLD if reached else None, **self._figures(track)}, track

    def _figures(self, track: Track) -> dict:
        """Figures of a way."""
        arm, dt = self.arm, self._dt
        q, qd = np.array(track.q), np.array(track.qd)
        acceleration = np.diff(qd, axis=0) / dt
        jerk = np.diff(acceleration, axis=0) / dt
        over = np.maximum(q - arm.upper, arm.lower - q).max()
        return {
            "position_error_m": track.miss[-1][0],
            "rotation_error_rad": track.miss[-1][1],
            "max_acceleration": float(np.abs(acceleration).max()),
            "max_jerk": float(np.abs(jerk).max()),
            "rms_jerk": float(np.sqrt((jerk**2).mean())),
            "limits_kept": bool(over <= 1e-3 and (np.abs(qd) <= 1.01 * arm.speed).all()),
            "touched": sorted(track.touched),
            "plan_ms": float(np.median(track.plan_ms)),
        }


def pose_miss(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses ``[7]``."""
    turn = Rotation.from_quat(a[3:]).inv() * Rotation.from_quat(b[3:])
    return float(np.linalg.norm(a[:3] - b[:3])), float(turn.magnitude())


@cache
def planned(scene: str, overrides: tuple[str, ...]) -> tuple[Course, Planner]:
    """Plant and planner of a scene, built once in every process."""
    import warpmpc
    from warpmpc.scene.model.compiled import compile_scene

    loaded = warpmpc.load_scene(scene, overrides=overrides)
    compiled = compile_scene(loaded)
    controller = warpmpc.Controller(loaded, device="cpu", seed=0, compiled=compiled)
    return Course(warpmpc.Plant(loaded, seed=0, task=controller.task, compiled=compiled)), Planner(controller)


@cache
def torqued(scene: str, overrides: tuple[str, ...]) -> tuple[Course, Torques]:
    """Plant and operational-space control of a scene, looked at as often as its planner would be."""
    import warpmpc

    every = round(warpmpc.load_scene(scene, overrides=overrides).timing.control_dt / PERIOD)
    plant = warpmpc.Plant(with_torques(scene, overrides), seed=0)
    return Course(plant, every=every), Torques(plant)


def run_pose(method: str, scene: str, overrides: tuple[str, ...], seed: int, clearance: float) -> dict:
    """One pose by one method; ``least`` runs nothing, it is the least time to a posture that has the pose.

    Raises:
        SceneError: If the scene does not fit.
        ValueError: If a package is missing.
    """
    course, pilot = (torqued if method == "osc" else planned)(scene, overrides)
    target = draw_pose(course.arm, seed, clearance=clearance)
    if method == "least":
        return {"seed": seed, **_least(course, target, seed)}
    record, _ = course.run(pilot, target, seed=seed)
    return {"seed": seed, **record}


def _least(course: Course, target: Reachable, seed: int) -> dict:
    """The least time in the form of a record."""
    postures = [target.posture, *course.arm.postures(target.pose, 20, seed=seed, margin=0.01)]
    limit = float(course.plant.layout.control_upper.min())
    errors = dict.fromkeys(("position_error_m", "rotation_error_rad", "max_acceleration", "max_jerk", "rms_jerk"))
    time = fastest(course.arm, limit, postures)
    return {"reached": True, "time_s": time, **errors, "limits_kept": True, "touched": []}
