# SPDX-License-Identifier: Apache-2.0
"""The plant: a simulated world that is observed and commanded like a robot."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...physics.runtime.launch import capturing
from ...scene.errors import SceneError, UnknownName
from ...scene.model.compiled import CompiledScene, compile_scene
from ...scene.model.layout import WORLD
from ...scene.model.state import Contact, State
from ...scene.task.conditions import StateSnapshot, chained
from ...scene.task.goal import GOAL, GoalError
from ...scene.task.task import Task
from ..estimation.scene_estimator import SceneEstimator
from .motion import Motions, Perturbation
from .sensors import DepthCamera, SimulatedSensors, require_sensors
from .worlds import Worlds

if TYPE_CHECKING:
    import mujoco

    from ...cost.term import UserTerm
    from ...scene.model.mujoco_model import MujocoWorld
    from ...scene.model.pairs import Pair
    from ...scene.schema import Camera, Kick, Scene
    from ..estimation.measurement import Measurement

CONTACT_FORCE = 1e-3
"""Net force above which two things count as touching [N]."""


def _raise(forces: dict[str, float], pairs: Sequence[Pair], peaks: np.ndarray) -> None:
    """Raise the largest force of each pair to a new one ``[pairs]``."""
    for pair, peak in zip(pairs, peaks, strict=True):
        name = f"{pair.first}-{pair.second}"
        forces[name] = max(forces.get(name, 0.0), float(peak))


class SimulatedPlant:
    """A simulated plant with its own physical properties, noise, delay and disturbances.

    ``contact`` is what robots and objects touched, ``pairs`` the pairs whose contact is reported, ``monitor`` knows
    about success and phases.

    Args:
        scene: The scene; its ``plant`` table says how the plant differs from the planner's worlds.
        seed: Seed of the plant's properties and noise.
        task: What the run wants, shared with its controller (``Plant(scene, task=mpc.task)``); a new one if None.
        terms: Users' own cost terms that success, failures, phases or ``watch`` name.
        watch: Cost terms whose values :attr:`terms` shall have, such as all of ``scene.cost_labels``.
        compiled: The scene compiled earlier, to save doing it again.
        world: Worlds of a batch that this plant lives in, and which of them; its own world if None.

    Raises:
        SceneError: If things stand deep inside each other at the start, a kick has the wrong number of values, or
            nothing measures what is estimated.
        ValueError: If the task has several environments.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int = 0,
        task: Task | None = None,
        terms: Sequence[UserTerm] = (),
        watch: Collection[str] = (),
        compiled: CompiledScene | None = None,
        world: tuple[Worlds, int] | None = None,
    ):
        self.scene, self.seed = scene, seed
        self.compiled = compiled or compile_scene(scene)
        if world is None:
            with capturing:  # nothing may be allocated while a controller records its plan
                world = Worlds(scene, self.compiled, [seed], task or Task(scene), terms, watch), 0
        self._worlds, self._index = world
        worlds = self._worlds
        self.layout, self.task, self._engine, self.pairs = worlds.layout, worlds.task, worlds.engine, worlds.pairs
        self.properties = worlds.draws[self._index] if worlds.draws else None
        self.monitor = worlds.monitors[self._index]
        self._start = self._engine.initial[self._index].copy()
        self._rng = np.random.default_rng([seed, 1])
        self._motions = Motions(scene, seed)
        self._sensors = SimulatedSensors(scene, self.compiled, self.world, seed)
        self.estimator = SceneEstimator(scene, self.compiled)
        """Estimates what the plant's sensors measure."""
        require_sensors(scene)
        self.measured: list[Measurement] = []
        """Measurements that were new in the last observation."""
        self._delay = round(scene.plant.delay / scene.timing.control_dt)
        self.cameras = {cloud.name: self._camera(cloud.camera, seed) for cloud in scene.cloud if cloud.camera}
        """Cameras that show the plant's world, by the clouds that they fill."""
        self.perturbation = Perturbation(self.compiled, self._engine, self._index)
        """Pulls and turns bodies of the plant's world; the planner knows nothing of it."""
        self._kicks = [(kick, self._kicked(i, kick)) for i, kick in enumerate(scene.plant.kicks)]
        self.reset()

    def reset(self) -> None:
        """Go back to the start state."""
        self._engine.initial[self._index] = self._start
        for i, pose in enumerate(self.layout.mocap):
            self._engine.move_mocap(self._index, i, pose)
        self._slice = 0  # of the trajectory: the start, later 1, the state after a control
        self.steps = 0
        for camera in self.cameras.values():
            camera.reset()
        self.contact = Contact()
        self.diverged = False
        self._paid = 0.0
        self.monitor.reset()
        self._motions.reset()
        self.perturbation.release()
        self._history: deque[State] = deque(maxlen=self._delay + 1)
        self._sensors.reset()
        self.estimator.reset()
        self._sensors.step(self._start[None], np.zeros(1), self._engine.control[self._index, :1])
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

    @property
    def sensors(self) -> np.ndarray:
        """Numbers that the sensors of MJCF files show at the last physics step ``[ns]``; zero before one."""
        return self._engine.trajectory.sensor.numpy()[0, self._index].copy()

    def observe(self) -> State:
        """The state as it is observed: with noise, and ``delay`` old, what sensors measure as it is estimated.

        Motions and clouds are shown to the task.
        """
        self._observe_scene()
        self.measured = self.measurements()
        for measurement in self.measured:
            self.estimator.update(measurement)
        return self.estimator.fill(self._observed())

    def measurements(self) -> list[Measurement]:
        """Measurements of sensors that became known since this was asked last, for your own estimator."""
        return self._sensors.known(self.time)

    def measure(self, time: float) -> list[Measurement]:
        """Measure once more with every sensor, apart from their rates: what stands still has measurements, too.

        Args:
            time: Time of the measurements [s].
        """
        i, engine = self._index, self._engine
        return self._sensors.once(engine.initial[i], time, engine.control[i, -1])

    def _observed(self) -> State:
        """The state before anything is estimated: with noise, and ``delay`` old."""
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

    @property
    def model(self) -> mujoco.MjModel:
        """The MuJoCo model that is stepped, with the plant's own properties; not to be changed."""
        return self._engine.models[self._index]

    @property
    def world(self) -> MujocoWorld:
        """The model of all plants that are stepped together, and how its arrays map to the layout."""
        return self._engine.world

    def show(self, data: mujoco.MjData) -> None:
        """Put the true state into a simulation state of :attr:`model`."""
        self._engine.show(self._index, data)

    def _camera(self, camera: Camera, seed: int) -> DepthCamera:
        """A camera in this plant's world."""
        robots = {entity.name for entity in self.layout.entities if entity.kind == "robot"}
        shapes = zip(self.layout.shapes, self.compiled.geom_name, strict=True)
        model = self.model
        own = [model.geom(name).id for shape, name in shapes if name and shape.entity in robots]
        return DepthCamera(camera, model, own, seed=seed)

    def _observe_scene(self) -> None:
        """Take the pictures whose time has come, and see what moves."""
        for name, position in self._motions.seen(self.time).items():
            self.task.move(name, position, self._index)
        for name, camera in self.cameras.items():
            if camera.due(self.time):
                self._engine.show(self._index, camera.data)
                self.task.see(name, camera.points(self.time), self._index)

    def apply(self, control: np.ndarray) -> None:
        """Hold a control ``[nu]`` for one control step.

        Raises:
            ValueError: If the control has the wrong shape or is not finite.
        """
        control = np.asarray(control, dtype=np.float32)
        if control.shape != (self.layout.nu,) or not np.isfinite(control).all():
            raise ValueError(f"a control of this scene is {self.layout.nu} finite numbers, not {control}")
        self.begin(control)
        self._worlds.step([self.time])
        self.end()

    def move_mocap(self, name: str, pose: np.ndarray) -> None:
        """Put a mocap body, ``robot/body``, somewhere else: a pose (x, y, z, qx, qy, qz, qw) in the world.

        Raises:
            UnknownName: If there is no such mocap body.
        """
        names = self.layout.mocap_name
        if name not in names:
            raise UnknownName("no such mocap body", found=name, allowed=names)
        self._engine.move_mocap(self._index, names.index(name), pose)

    def begin(self, control: np.ndarray) -> None:
        """The part of :meth:`apply` before the engine's step: kicks, pulls, movable obstacles, the control ``[nu]``."""
        self._disturb()
        self.perturbation.act()
        if self.layout.movable:
            poses = [self.pose(name) for name in self.layout.movable]
            self._engine.place_obstacles(self._index, np.array(poses))
        self._worlds.control.numpy()[0, self._index] = control

    def end(self) -> None:
        """The part of :meth:`apply` after the engine's step: take note of the state reached."""
        engine, i = self._engine, self._index
        self._slice = 1
        self.steps += 1
        self.diverged = bool(engine.trajectory.diverged.numpy()[i])
        rows = engine.state[i]
        before = self.time - self.scene.timing.control_dt
        self._sensors.step(rows, before + engine.model.opt.timestep * np.arange(1, len(rows) + 1), engine.control[i])
        engine.initial[i] = engine.state[i, -1]
        engine.initial[i, 0] = 0.0
        self._paid += sum(float(np.atleast_1d(self.task[n])[i]) * value for n, value in self.terms.items())
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
        floating = any(layout.joint_type[joint] == 4 for joint in entity.joints[:1])
        if floating and len(kick.velocity) == 3:
            columns = columns[:3]
        if len(columns) != len(kick.velocity):
            raise SceneError(
                f"needs {len(columns)} values for '{kick.target}'",
                key=f"{key}.velocity",
                file=self.scene.path,
                found=list(kick.velocity),
            )
        return columns

    def _feel(self) -> None:
        """Record contacts between robots, objects and obstacles at every physics step."""
        touching = self._worlds.touching
        if not self.pairs + touching:
            return
        force = np.linalg.norm(self._measured(), axis=-1)
        step, colliding = self._engine.model.opt.timestep, len(self.pairs)
        self.contact.time += step * int((force[:, :colliding] > CONTACT_FORCE).any(axis=1).sum())
        peaks = force.max(axis=0)
        _raise(self.contact.forces, self.pairs, peaks[:colliding])
        _raise(self.contact.touches, touching, peaks[colliding:])
        self.contact.max_force = max(self.contact.forces.values(), default=0.0)

    def _check(self) -> None:
        """Take note of the state just reached."""
        self._moving = self._motions.at(self.time)
        self._history.append(self.state)
        state = self._history[-1]
        poses = {name: self.pose(name) for name in self._moving}
        self.monitor.check(StateSnapshot(self.body_q, state.joint_q, self.terms, poses), self.time)

    def _measured(self) -> np.ndarray:
        """Net forces on the first of pairs that collide, then of those that touch, ``[n, pairs, 3]`` [N], by step."""
        return self._engine.pair_force(self._index)[:, self._worlds.first_pair :]

    @property
    def goal(self) -> np.ndarray:
        """Pose of the goal ``[7]``."""
        return self.pose(GOAL)

    def pose(self, name: str) -> np.ndarray:
        """True pose ``[7]`` of a frame: the goal, a target, an object, an obstacle, ``robot/frame`` or ``robot/link``.

        Raises:
            UnknownName: If there is no such frame.
        """
        if name not in self.task.pose_name:
            index = self.layout.frame(name)
            body, local = int(self.layout.frame_body[index]), self.layout.frame_pose[index]
            return local.copy() if body == WORLD else chained(self.body_q[body], local)
        pose = self.task.pose(name, self._index).copy()
        if name in self._moving:
            pose[:3] = self._moving[name]
        return pose

    @property
    def error(self) -> GoalError | None:
        """Distance of the goal's object or frame from the goal; None for a scene without a goal."""
        return self.monitor.error

    @property
    def terms(self) -> dict[str, float]:
        """Cost of each watched term after the last control, without its weight; empty before one."""
        return dict(self._worlds.terms[self._index]) if self._slice else {}

    @property
    def mean_cost(self) -> float:
        """Mean over all controls of what the watched terms cost after them, with their weights; NaN before one."""
        return self._paid / self.steps if self.steps else math.nan

    @property
    def forces(self) -> np.ndarray:
        """Net contact force on the first of each of :attr:`pairs` at the last physics step ``[pairs, 3]`` [N]."""
        return self._measured()[-1, : len(self.pairs)]

    @property
    def success(self) -> bool:
        """Return whether everything that is wanted holds and did so long enough."""
        return self.monitor.success

    @property
    def done(self) -> bool:
        """Return whether the episode is over: goal reached, failed, time out or the physics diverged."""
        over = self.success or self.diverged or self.monitor.failure is not None
        return over or self.time >= self.scene.timing.timeout - 1e-9

    @property
    def reason(self) -> str:
        """Reason for which the episode is over."""
        if self.success:
            return "goal reached"
        if self.diverged:
            return "the plant's physics diverged"
        if self.monitor.failure is not None:
            return f"failed: {self.monitor.failure}"
        return "timeout" if self.done else "running"
