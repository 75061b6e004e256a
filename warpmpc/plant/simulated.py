# SPDX-License-Identifier: Apache-2.0
"""The plant: a simulated world of its own that is observed and commanded like a robot."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..engine.mujoco import MujocoEngine
from ..engine.trajectory import ObservedState, Shape
from ..model.compiled import CompiledScene, compile_scene
from ..model.mujoco_model import Options
from ..model.pairs import collision_pairs
from ..model.properties import Properties, draw_properties
from ..model.state import Contact, State
from ..scene.errors import SceneError
from ..task.goal import GoalError, goal_error, goal_pose

if TYPE_CHECKING:
    from ..scene.schema import Kick, Scene
    from .batch import PlantBatch

_SUBSTEPS = 8
"""Physics steps per control where neither the scene nor an MJCF file says anything: finer than the planner's."""
_SOLVER = {"iterations": 100, "tolerance": 1e-8}
_AS_THE_FILE_SAYS = {"iterations": None, "tolerance": None}
CONTACT_FORCE = 1e-3
"""Net force above which two things count as touching [N]."""


@dataclass(frozen=True)
class PlantWorld:
    """Where a plant lives: one world of an engine."""

    engine: MujocoEngine
    control: wp.array
    """Controls of all worlds of the engine ``[1, E, nu]``."""
    index: int
    """Which world of the engine."""
    properties: Properties | None
    """Draw of the plant's physical properties, None for nominal ones."""


def plant_worlds(scene: Scene, compiled: CompiledScene, seeds: Sequence[int]) -> list[PlantWorld]:
    """Worlds of one engine at the start state, for one plant per seed.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        seeds: Seeds of the plants' properties.
    """
    layout, draws = compiled.layout, None
    if scene.plant.randomize:
        draws = [draw_properties(scene, layout, 1, seed=2 * seed + 1) for seed in seeds]
    engine = MujocoEngine(
        compiled,
        Shape(len(seeds), 1, 1, 1),
        control_dt=scene.timing.control_dt,
        substeps=compiled.substeps(scene.plant.substeps, scene.timing.control_dt, _SUBSTEPS),
        pairs=collision_pairs(layout, {obstacle.name for obstacle in scene.obstacle if obstacle.support}),
        properties=_stacked(draws) if draws else None,
        threads=1 if len(seeds) == 1 else 0,
        options=Options.of(scene.engine, **_SOLVER if not compiled.natives else _AS_THE_FILE_SAYS),
    )
    start = (np.tile(a, (len(seeds), 1)) for a in (layout.joint_q, layout.joint_qd))
    engine.clone(ObservedState(*(wp.array(a, dtype=float, device="cpu") for a in start)))
    control = wp.zeros((1, len(seeds), layout.nu), dtype=float, device="cpu")
    return [PlantWorld(engine, control, i, draws[i] if draws else None) for i in range(len(seeds))]


def _stacked(draws: Sequence[Properties]) -> Properties:
    """Draws of one plant each as draws of one batch."""
    rows = (np.concatenate([getattr(draw, field) for draw in draws]) for field in ("mass", "friction", "size"))
    return Properties(draws[0].names, *rows)


class Plant:
    """A simulated plant with physical properties, noise, delay and disturbances of its own.

    ``error`` is how far the goal's object or frame is from the goal, ``contact`` what robots and objects touched,
    ``pairs`` the pairs whose contact is watched.

    Args:
        scene: The scene; its ``plant`` table says how the plant differs from the planner's worlds.
        seed: Seed of the plant's properties and noise.
        envs: Number of plants E. With more than one this makes a :class:`~warpmpc.plant_batch.PlantBatch` of plants
            with the seeds ``seed, seed + 1, ...``, whose states and controls have a leading axis ``[E]``.
        compiled: The scene compiled earlier, to save doing it again.
        world: World of a batch's engine that this plant lives in; an engine of its own if None.

    Raises:
        SceneError: If a kick has the wrong number of values.
        ValueError: If there is to be less than one plant.
    """

    def __new__(cls, scene: Scene, *, seed: int = 0, envs: int = 1, **keys: object) -> Plant | PlantBatch:
        """A plant, or a batch of them."""
        if envs < 1:
            raise ValueError(f"there is at least one plant, not {envs}")
        if envs == 1:
            return super().__new__(cls)
        from .batch import PlantBatch

        return PlantBatch([scene] * envs, seeds=range(seed, seed + envs), **keys)

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int = 0,
        envs: int = 1,
        compiled: CompiledScene | None = None,
        world: PlantWorld | None = None,
    ):
        self.scene = scene
        self.compiled = compiled or compile_scene(scene)
        self.layout = self.compiled.layout
        self._world = world or plant_worlds(scene, self.compiled, [seed])[0]
        self._engine, self._index = self._world.engine, self._world.index
        self.pairs, self.properties = self._engine.pairs, self._world.properties
        self._start = self._engine.initial[self._index].copy()
        self._rng = np.random.default_rng([seed, 1])
        self._delay = round(scene.plant.delay / scene.timing.control_dt)
        self._kicks = [(kick, self._kicked(i, kick)) for i, kick in enumerate(scene.plant.kicks)]
        self.goal = goal_pose(scene)
        self.reset()

    def reset(self) -> None:
        """Go back to the start state."""
        self._engine.initial[self._index] = self._start
        self._slice = 0  # of the trajectory: the start, later 1, the state after a control
        self.steps = 0
        self.contact = Contact()
        self.diverged = False
        self._within = 0
        self._history: deque[State] = deque(maxlen=self._delay + 1)
        self._check()

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.steps * self.scene.timing.control_dt

    @property
    def state(self) -> State:
        """The true state."""
        out = self._engine.trajectory
        at = self._slice, self._index
        return State(
            out.joint_q.numpy()[at].copy(),
            out.joint_qd.numpy()[at].copy(),
            time=self.time,
            act=out.act.numpy()[at].copy(),
            mocap=self._engine.mocap_pose.numpy()[self._index].copy(),
        )

    @property
    def body_q(self) -> np.ndarray:
        """True poses of all bodies ``[nb, 7]``."""
        return self._engine.trajectory.body_q.numpy()[self._slice, self._index].copy()

    def observe(self) -> State:
        """The state as sensors show it: with noise, and ``delay`` old."""
        state = self._history[0]
        noise = self.scene.plant.noise
        if not noise.position and not noise.velocity:
            return state
        q = state.joint_q + self._rng.normal(0.0, noise.position, state.joint_q.shape)
        for joint, kind in enumerate(self.layout.joint_type):
            if kind in (2, 4):  # ball and free joints hold a quaternion last
                i = self.layout.joint_q_start[joint] + (3 if kind == 4 else 0)
                q[i : i + 4] /= np.linalg.norm(q[i : i + 4])
        qd = state.joint_qd + self._rng.normal(0.0, noise.velocity, state.joint_qd.shape)
        return replace(state, joint_q=q.astype(np.float32), joint_qd=qd.astype(np.float32))

    def apply(self, control: np.ndarray) -> None:
        """Hold a control ``[nu]`` for one control step.

        Raises:
            ValueError: If the control has the wrong shape or is not finite.
        """
        control = np.asarray(control, dtype=np.float32)
        if control.shape != (self.layout.nu,) or not np.isfinite(control).all():
            raise ValueError(f"a control of this scene is {self.layout.nu} finite numbers, not {control}")
        self.begin(control)
        self._engine.rollout(self._world.control)
        self.end()

    def move_mocap(self, name: str, pose: np.ndarray) -> None:
        """Put a mocap body, ``robot/body``, somewhere else: a pose (x, y, z, qx, qy, qz, qw) in the world.

        Raises:
            SceneError: If there is no such mocap body.
        """
        names = self.layout.mocap_name
        if name not in names:
            raise SceneError("no such mocap body", key="mocap", found=name, allowed=names)
        self._engine.move_mocap(self._index, names.index(name), pose)

    def begin(self, control: np.ndarray) -> None:
        """The part of :meth:`apply` before the engine's step: kicks and the control ``[nu]``."""
        self._disturb()
        self._world.control.numpy()[0, self._index] = control

    def end(self) -> None:
        """The part of :meth:`apply` after the engine's step: take note of the state reached."""
        engine, i = self._engine, self._index
        self._slice = 1
        self.steps += 1
        self.diverged = bool(engine.trajectory.diverged.numpy()[i])
        engine.initial[i] = engine.state[i, -1]
        engine.initial[i, 0] = 0.0
        self._feel()
        self._check()

    def _disturb(self) -> None:
        """Add the velocity of kicks whose time has come."""
        dt = self.scene.timing.control_dt
        for kick, columns in self._kicks:
            # counted in whole steps: a sum of times may miss its own border
            if self.steps == math.floor(kick.time / dt + 1e-6):
                self._engine.initial[self._index, columns] += kick.velocity

    def _kicked(self, i: int, kick: Kick) -> list[int]:
        """Columns of the physics state that a kick changes."""
        key, layout = f"plant.kicks[{i}]", self.layout
        entity = layout.entity(kick.target, key=f"{key}.target")
        first = 1 + self._engine.model.nq
        columns = []
        for joint in entity.joints:
            start = self._engine.joint_qd[joint]
            if start >= 0:
                width = 3 if layout.joint_type[joint] == 4 else int(layout.joint_dof_dim[joint].sum())
                columns += [first + start + k for k in range(width)]
        if len(columns) != len(kick.velocity):
            raise SceneError(
                f"needs {len(columns)} values for '{kick.target}'",
                key=f"{key}.velocity",
                file=self.scene.path,
                found=list(kick.velocity),
            )
        return columns

    def _feel(self) -> None:
        """Record contacts between robots and obstacles at every physics step."""
        if not self.pairs:
            return
        force = np.linalg.norm(self._engine.pair_force(self._index), axis=-1)
        step = self._engine.model.opt.timestep
        self.contact.time += step * int((force > CONTACT_FORCE).any(axis=1).sum())
        for pair, peak in zip(self.pairs, force.max(axis=0), strict=True):
            name = f"{pair.first}-{pair.second}"
            self.contact.forces[name] = max(self.contact.forces.get(name, 0.0), float(peak))
        self.contact.max_force = max(self.contact.forces.values())

    def _check(self) -> None:
        """Take note of the state just reached."""
        self._history.append(self.state)
        self.error = self._goal_error()
        self._within = self._within + 1 if self.error.within(self.scene.success) else 0

    def _goal_error(self) -> GoalError:
        frame = self.layout.frame(self.scene.goal.target, key="goal")
        pose = wp.transform(*self.body_q[self.layout.frame_body[frame]]) * wp.transform(*self.layout.frame_pose[frame])
        return goal_error(self.scene.goal, self.goal, np.array([*pose.p, *pose.q]))

    @property
    def forces(self) -> np.ndarray:
        """Net contact force on the first of each of :attr:`pairs` at the last physics step ``[pairs, 3]`` [N]."""
        return self._engine.pair_force(self._index)[-1]

    @property
    def success(self) -> bool:
        """Whether the goal is reached and was held long enough."""
        # states stand at the ends of steps: n steps of holding are n + 1 states
        return self._within - 1 >= self.scene.success.hold / self.scene.timing.control_dt - 1e-6

    @property
    def done(self) -> bool:
        """Whether the episode is over: goal reached, time out or the physics diverged."""
        return self.success or self.diverged or self.time >= self.scene.timing.timeout - 1e-9

    @property
    def reason(self) -> str:
        """Why the episode is over."""
        if self.success:
            return "goal reached"
        if self.diverged:
            return "the plant's physics diverged"
        return "timeout" if self.done else "running"
