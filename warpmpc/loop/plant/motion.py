# SPDX-License-Identifier: Apache-2.0
"""Things that move by themselves in a simulated plant: true and observed positions.

A hand in a plant's world: it takes hold of a body and pulls or turns it, as the mouse does in MuJoCo's viewer.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.interpolate import PchipInterpolator

from ...scene.errors import UnknownName

if TYPE_CHECKING:
    from ...engine.mujoco import MujocoSimulator
    from ...scene.model.compiled import CompiledScene
    from ...scene.schema import Motion, Scene

SLACK = 1e-6
"""Tolerance of lapses of time [s]: times are sums of steps."""


class MotionPath:
    """Path of one thing over time.

    Monotone between points along every axis (Fritsch and Carlson 1980): nothing is overshot, and what waits stands.

    Args:
        motion: What the scene says of it.
    """

    def __init__(self, motion: Motion):
        points, self._period, self._start = np.array(motion.through, dtype=float), motion.period, motion.start
        count = len(points)
        times = np.arange(count) * self._period / count if motion.times is None else np.array(motion.times)
        if self._period is not None:  # three rounds, so that the middle one has neither beginning nor end
            times = np.concatenate([times + turn * self._period for turn in (-1, 0, 1)])
            points = np.tile(points, (3, 1))
        self._first, self._last = times[0], times[-1]
        self._curve = PchipInterpolator(times, points)

    def __call__(self, time: float) -> np.ndarray:
        """Position ``[3]`` at a time [s]."""
        t = max(time - self._start, 0.0)
        t = min(t, self._last) if self._period is None else t % self._period
        return self._curve(t)


class Observer:
    """Observations of one thing that moves.

    Args:
        motion: What the scene says of it.
        control_dt: Length of a control [s].
        seed: Seed of the observations' noise.
    """

    def __init__(self, motion: Motion, control_dt: float, seed: list[int]):
        self.name, self.path, self._seen = motion.name, MotionPath(motion), motion.seen
        self._rate, self._seed = motion.seen.rate or 1.0 / control_dt, seed
        self.reset()

    def reset(self) -> None:
        """Forget what was observed, and begin the noise anew."""
        self._rng, self._count = np.random.default_rng(self._seed), -1
        self._rows: deque[tuple[float, np.ndarray]] = deque(maxlen=max(2, round(self._seen.over * self._rate)))

    def __call__(self, time: float) -> np.ndarray:
        """Position that the planner is shown ``[3]`` at a time [s], which never goes back."""
        count = int((time + SLACK) * self._rate)
        if count > self._count:
            self._count = count
            at = count / self._rate
            self._rows.append((at, self.path(at) + self._rng.normal(0.0, self._seen.noise, 3)))
        if self._seen.lead == 0.0 or len(self._rows) < 2:
            return self._rows[-1][1]
        times, positions = map(np.array, zip(*self._rows, strict=True))
        ago = times - times.mean()
        velocity = ago @ positions / (ago @ ago)
        return positions.mean(axis=0) + velocity * (time + self._seen.lead - times.mean())


class Motions:
    """All that moves by itself in one plant.

    Args:
        scene: The scene.
        seed: Seed of the observations' noise.
    """

    def __init__(self, scene: Scene, seed: int):
        dt = scene.timing.control_dt
        self._observers = [Observer(motion, dt, [seed, 2, i]) for i, motion in enumerate(scene.motion)]

    def reset(self) -> None:
        """Go back to the beginning."""
        for observer in self._observers:
            observer.reset()

    def at(self, time: float) -> dict[str, np.ndarray]:
        """Positions of everything ``[3]``, by name."""
        return {observer.name: observer.path(time) for observer in self._observers}

    def seen(self, time: float) -> dict[str, np.ndarray]:
        """Positions that the planner is shown ``[3]``, by name."""
        return {observer.name: observer(time) for observer in self._observers}


STEPS = 0.4
"""Stiffest spring: this over the length of a control is its angular frequency, as the force is held that long."""


class Perturbation:
    """Holds at most one body, by damped springs that are as stiff as what they move is heavy.

    The springs are MuJoCo's (``mjv_applyPerturbForce``): one from the point taken hold of to where the hand is, one
    from the body's orientation to the hand's. Their force and moment are computed before every control and held for
    its length.

    Args:
        compiled: The scene, compiled.
        engine: Worlds that bodies can be pushed in.
        world: Which of them.
    """

    def __init__(self, compiled: CompiledScene, engine: MujocoSimulator, world: int):
        self._engine, self._world, self._model = engine, world, engine.models[world]
        names = zip(compiled.layout.body_name, compiled.body_name, strict=True)
        self._body = {name: self._model.body(own).id for name, own in names}
        frequency, springs = STEPS / (engine.steps * self._model.opt.timestep), self._model.vis.map
        springs.stiffness = min(springs.stiffness, frequency**2)
        springs.stiffnessrot = min(springs.stiffnessrot, frequency**2)
        self._data = mujoco.MjData(self._model)
        self._grip = mujoco.MjvPerturb()
        self.body: str | None = None
        """Body held, None for none."""

    def grab(self, body: str, point: np.ndarray) -> None:
        """Take hold of a body where it is at a point of the world ``[3]`` [m]; until it is moved, the hand is there.

        Raises:
            UnknownName: If there is no such body.
        """
        if body not in self._body:
            raise UnknownName("no such body", found=body, allowed=list(self._body))
        self._take_state()
        model, data, grip, index = self._model, self._data, self._grip, self._body[body]
        turned = data.xmat[index].reshape(3, 3)
        grip.select, grip.active = index, 0
        grip.localpos[:] = turned.T @ (np.asarray(point) - data.xpos[index])
        grip.refselpos[:] = point
        mujoco.mju_mulQuat(grip.refquat, data.xquat[index], model.body_iquat[index])
        self._held = grip.refquat.copy()
        grip.localmass = self._mass(point, index)
        self.body = body

    def pull(self, point: np.ndarray) -> None:
        """Put the hand at a point of the world ``[3]`` [m]; what it holds is pulled there."""
        self._grip.refselpos[:] = point
        self._grip.active = int(mujoco.mjtPertBit.mjPERT_TRANSLATE)

    def turn(self, rotation: np.ndarray) -> None:
        """Turn the hand, and what it holds with it, by a rotation vector in the world ``[3]`` [rad] since the grab."""
        angle = float(np.linalg.norm(rotation))
        turned = np.zeros(4)
        mujoco.mju_axisAngle2Quat(turned, np.asarray(rotation) / max(angle, 1e-9), angle)
        mujoco.mju_mulQuat(self._grip.refquat, turned, self._held)
        self._grip.active = int(mujoco.mjtPertBit.mjPERT_ROTATE)

    def release(self) -> None:
        """Let go."""
        if self.body is not None:
            self.body = None
            self._engine.wrenches(self._world)[:] = 0.0

    @property
    def spring(self) -> np.ndarray | None:
        """Ends of the spring that pulls, at the body and at the hand, ``[2, 3]`` [m]; None if nothing is pulled at."""
        if self.body is None or not self._grip.active & int(mujoco.mjtPertBit.mjPERT_TRANSLATE):
            return None
        self._take_state()
        data, grip = self._data, self._grip
        at = data.xpos[grip.select] + data.xmat[grip.select].reshape(3, 3) @ grip.localpos
        return np.stack([at, grip.refselpos])

    def act(self) -> None:
        """Give the engine the force and moment to hold during the next control."""
        if self.body is None:
            return
        self._take_state()
        self._data.xfrc_applied[:] = 0.0
        mujoco.mjv_applyPerturbForce(self._model, self._data, self._grip)
        self._engine.wrenches(self._world)[:] = self._data.xfrc_applied

    def _take_state(self) -> None:
        """Bring poses and velocities to where the world is."""
        self._engine.show(self._world, self._data)
        mujoco.mj_forward(self._model, self._data)

    def _mass(self, point: np.ndarray, body: int) -> float:
        """Apparent mass at a point to a pull there, the mean of all directions [kg]."""
        jacobian, moved = np.zeros((3, self._model.nv)), np.zeros((3, self._model.nv))
        mujoco.mj_jac(self._model, self._data, jacobian, None, np.asarray(point, dtype=float), body)
        mujoco.mj_solveM(self._model, self._data, moved, jacobian)
        return 3.0 / max(float(np.sum(jacobian * moved)), 1e-9)
