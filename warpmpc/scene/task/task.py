# SPDX-License-Identifier: Apache-2.0
"""Task: what a run wants and may change between plans: poses, scalars, term weights, point clouds, the active phase.

The point clouds of a task: what is seen, for each environment its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MethodType
from typing import TYPE_CHECKING
from weakref import WeakMethod

import numpy as np

from ..errors import UnknownName
from ..model.layout import GOAL as GOAL_BODY
from ..schema_bodies import Cloud
from .goal import GOAL, goal_pose, target_pose

if TYPE_CHECKING:
    from ..model.layout import Layout
    from ..model.state import State
    from ..schema import Phase, Scene


class Clouds:
    """Points of every cloud of a scene, none at the start.

    Args:
        clouds: The scene's clouds.
        envs: Number of environments E.
    """

    def __init__(self, clouds: Sequence[Cloud], envs: int):
        self._capacity = {cloud.name: cloud.capacity for cloud in clouds}
        self._envs = envs
        self._nothing = np.zeros((0, 3), dtype=np.float32)
        self._points = {name: [self._nothing] * envs for name in self._capacity}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the clouds."""
        return tuple(self._capacity)

    def points(self, name: str, e: int = 0) -> np.ndarray:
        """Points of an environment ``[n, 3]`` [m], an array that is not changed."""
        return self._rows(name)[e]

    def set(self, name: str, value: object, e: int | None = None) -> None:
        """Take a copy of points.

        Args:
            name: Cloud.
            value: Points ``[n, 3]``, or a list of them with one entry for each environment.
            e: Environment they belong to; all if None.

        Raises:
            ValueError: If they have the wrong shape or are more than the cloud has capacity for.
        """
        rows = self._rows(name)
        each = isinstance(value, list | tuple) and len(value) == self._envs and e is None and np.ndim(value[0]) == 2
        checked = [self._checked(name, v) for v in value] if each else [self._checked(name, value)] * self._envs
        for i in range(self._envs) if e is None else (e,):
            rows[i] = checked[i]

    def reset(self, e: int) -> None:
        """Forget the points of an environment."""
        for rows in self._points.values():
            rows[e] = self._nothing

    def _rows(self, name: str) -> list[np.ndarray]:
        if name not in self._points:
            raise UnknownName("the task has no such cloud", found=name, allowed=self._points)
        return self._points[name]

    def _checked(self, name: str, value: object) -> np.ndarray:
        try:
            points = np.array(value, dtype=np.float32, order="C")
        except (TypeError, ValueError):
            points = np.zeros(1, dtype=np.float32)
        if points.shape in ((0,), (0, 3)):
            return self._nothing
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"'{name}' is a cloud of points [n, 3], not {_shape(value)}")
        if len(points) > self._capacity[name]:
            raise ValueError(
                f"'{name}' has capacity for {self._capacity[name]} points, not for {len(points)}: "
                "give the scene's cloud a larger capacity"
            )
        return points


def _shape(value: object) -> str:
    try:
        return f"of shape {list(np.shape(value))}"
    except ValueError:
        return "rows of different lengths"


POSE = 7
"""Numbers of a pose (x, y, z, qx, qy, qz, qw)."""


class Task(Mapping[str, np.ndarray]):
    """The task of one run, or of E of them: ``task["goal"] = pose`` takes effect at the next plan.

    Names are those of the scene: ``goal``, its targets, its movable obstacles, its scalars, its point clouds, and its
    cost terms, whose value is their weight.
    A controller, its plant and a recorder that share one task all see what changes.

    Args:
        scene: The scene.
        envs: Number of environments E.
    """

    # a task is itself: two of equal values are two tasks
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def __init__(self, scene: Scene, *, envs: int = 1):
        self.scene, self.envs = scene, envs
        poses = {GOAL: goal_pose(scene), **{t.name: target_pose(t) for t in scene.target}}
        poses |= {o.name: np.array([*o.position, *o.rotation], np.float32) for o in scene.obstacle if o.movable}
        weights = {label: cost.weight for label, cost in zip(scene.cost_labels, scene.cost, strict=True)}
        self.pose_name, self.scalar_name, self.weight_name = tuple(poses), tuple(scene.scalar), tuple(weights)
        self._columns = {name: slice(POSE * i, POSE * (i + 1)) for i, name in enumerate(poses)}
        self._clouds = Clouds(scene.cloud, envs)
        first = POSE * len(poses)
        for i, name in enumerate((*scene.scalar, *weights)):
            self._columns[name] = slice(first + i, first + i + 1)
        start = np.concatenate([*poses.values(), list(scene.scalar.values()), list(weights.values())])
        self._start = np.tile(start.astype(np.float32), (envs, 1))
        self.block = self._start.copy()
        """All of it as one row per environment: poses, scalars, weights ``[E, 7 poses + scalars + terms]``."""
        self.phase = np.zeros(envs, dtype=int)
        """Active phase of each environment, an index into the scene's ``phase`` list, ``[E]``."""
        self._listeners: list[Callable[[], Callable[[frozenset[str]], None] | None]] = []
        self.reset()

    def on_change(self, listener: Callable[[frozenset[str]], None]) -> None:
        """Call ``listener(names)`` after every change; a method for as long as its object lives."""
        method = isinstance(listener, MethodType)
        self._listeners.append(WeakMethod(listener) if method else lambda: listener)

    def reset(self, e: int | None = None) -> None:
        """Go back to the scene's own values and to its first phase.

        Args:
            e: Environment, all of them if None.
        """
        for row in range(self.envs) if e is None else (e,):
            self.block[row] = self._start[row]
            self.phase[row] = 0
            self._clouds.reset(row)
            self._enter(row)
        self._tell(set(self))

    def take(self, tasks: Sequence[Task]) -> None:
        """Make the present values of one-environment tasks the start of each environment, and go back to it.

        Args:
            tasks: Tasks of scenes that differ in nothing but values, one for each environment.
        """
        self._start = np.concatenate([task.block for task in tasks])
        self.reset()

    def follow(self, block: np.ndarray, e: int = 0) -> None:
        """Take over the values of another task of the same scene, such as one in another process.

        Args:
            block: Row of its :attr:`block` ``[7 poses + scalars + terms]``.
            e: Environment.
        """
        changed = self.block[e] != block
        if changed.any():
            self.block[e] = block
            self._tell({name for name, column in self._columns.items() if changed[column].any()})

    def __getitem__(self, name: str) -> np.ndarray:
        """A pose ``[7]``, scalar or weight, a copy; with a leading axis ``[E]`` for several environments.

        Points of a cloud ``[n, 3]`` are those of the first; :meth:`points` tells the others'.
        """
        if name in self._clouds.names:
            return self.points(name).copy()
        value = self.block[:, self._column(name)].copy()
        if name not in self.pose_name:
            value = value[:, 0]
        return value if self.envs > 1 else value[0]

    def __setitem__(self, name: str, value: object) -> None:
        """Change a pose, scalar, weight or cloud, of all environments or of each its own.

        Args:
            name: Its name in the scene.
            value: Pose ``[7]`` or ``[E, 7]``, quaternions are normalized; a number, or ``[E]`` of them; points
                ``[n, 3]`` of a cloud, or a list of E such arrays. Points that are not finite are dropped.

        Raises:
            UnknownName: If the task has nothing of this name; it is a ``KeyError``.
            ValueError: If the value is not finite or of the wrong shape, a weight is negative, a quaternion is zero, or
                there are more points than the cloud has capacity for.
        """
        if name in self._clouds.names:
            self._clouds.set(name, value)
            self._tell({name})
            return
        column = self._column(name)
        if name in self.pose_name:
            value = self._checked_pose(name, value)
        else:
            value = np.array(value, dtype=np.float32)
            if value.shape not in ((), (self.envs,)) or not np.isfinite(value).all():
                raise ValueError(f"'{name}' is a finite number, not {value}")
            if name in self.weight_name and (value < 0.0).any():
                raise ValueError(f"'{name}' is a weight, 0 or more, not {value}: costs are minimized")
            value = value.reshape(-1, 1)
        self.block[:, column] = value
        self._tell({name})

    def _checked_pose(self, name: str, value: object) -> np.ndarray:
        pose = np.array(value, dtype=np.float32)
        right = pose.shape in ((POSE,), (self.envs, POSE))
        if not right or not np.isfinite(pose).all() or not pose[..., 3:].any(axis=-1).all():
            raise ValueError(f"'{name}' is a pose of seven finite numbers (x, y, z, qx, qy, qz, qw), not {pose}")
        pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
        return pose

    def __iter__(self) -> Iterator[str]:
        return iter((*self._columns, *self._clouds.names))

    def __len__(self) -> int:
        return len(self._columns) + len(self._clouds.names)

    def pose(self, name: str, e: int = 0) -> np.ndarray:
        """Pose ``[7]`` of one environment, not a copy.

        Raises:
            UnknownName: If the task has no pose of this name.
        """
        if name not in self.pose_name:
            raise UnknownName("the task has no such pose", found=name, allowed=self.pose_name)
        return self.block[e, self._columns[name]]

    def values(self, e: int = 0) -> dict[str, np.ndarray | float]:
        """Poses ``[7]`` and scalars of one environment by name, copies."""
        poses = {name: self.pose(name, e).copy() for name in self.pose_name}
        return poses | {name: float(self.block[e, self._columns[name]][0]) for name in self.scalar_name}

    def move(self, name: str, position: np.ndarray, e: int = 0) -> None:
        """Put a pose of one environment somewhere else ``[3]``; it keeps its orientation."""
        at = self.pose(name, e)[:3]
        if not np.array_equal(at, position := np.asarray(position, dtype=np.float32)):
            at[:] = position
            self._tell({name})

    def points(self, name: str, e: int = 0) -> np.ndarray:
        """Points ``[n, 3]`` of a cloud in one environment, not to be changed.

        Raises:
            UnknownName: If the task has no cloud of this name.
        """
        return self._clouds.points(name, e)

    def see(self, name: str, points: np.ndarray, e: int = 0) -> None:
        """Change the points ``[n, 3]`` of a cloud in one environment.

        Raises:
            UnknownName: If the task has no cloud of this name.
            ValueError: If they have the wrong shape or are more than the cloud has capacity for.
        """
        self._clouds.set(name, points, e)
        self._tell({name})

    def phase_of(self, e: int = 0) -> Phase | None:
        """The active phase of an environment, None for a scene without phases."""
        return self.scene.phase[self.phase[e]] if self.scene.phase else None

    def enter_phase(self, index: int, e: int = 0) -> None:
        """Go on to a phase: what it names takes its values, everything else stays.

        Raises:
            IndexError: If there is no such phase.
        """
        if not 0 <= index < len(self.scene.phase):
            raise IndexError(f"there are {len(self.scene.phase)} phases, none with index {index}")
        self.phase[e] = index
        self._tell(self._enter(e))

    def _enter(self, e: int) -> set[str]:
        """Write what the active phase changes; returns the names."""
        phase = self.phase_of(e)
        if phase is None:
            return set()
        poses = {name: target_pose(pose) for name, pose in phase.target.items()}
        if phase.goal is not None:
            poses[GOAL] = goal_pose(self.scene, phase.goal)
        for name, value in {**poses, **phase.scalar, **phase.weight}.items():
            self.block[e, self._columns[name]] = value
        return {*poses, *phase.scalar, *phase.weight}

    def _column(self, name: str) -> slice:
        if name not in self._columns:
            raise UnknownName("the task has no such value", found=name, allowed=self)
        return self._columns[name]

    def _tell(self, names: set[str]) -> None:
        self._listeners = [listener for listener in self._listeners if listener() is not None]
        for listener in self._listeners:
            if (call := listener()) is not None:
                call(frozenset(names))


def task_layout(layout: Layout, scene: Scene) -> Layout:
    """A compiled scene's layout with the task's poses as frames: targets, movable obstacles, a goal if there is one."""
    frames = list(zip(layout.frame_name, layout.frame_body, layout.frame_pose, strict=True))
    left_out = {*layout.movable, *([GOAL] if scene.goal is None else [])}
    frames = [frame for frame in frames if frame[0] not in left_out]
    identity = np.array([0.0] * 6 + [1.0], dtype=np.float32)
    more = (*(target.name for target in scene.target), *layout.movable)
    frames += [(name, GOAL_BODY - 1 - i, identity) for i, name in enumerate(more)]
    names, bodies, poses = zip(*frames, strict=True)
    return layout.replace(
        frame_name=names, frame_body=np.array(bodies, dtype=np.int32), frame_pose=np.array(poses, dtype=np.float32)
    )


Propose = Callable[["State", Mapping[str, "np.ndarray | float"], "np.ndarray"], "np.ndarray | None"]
"""``(state, task, times) -> controls``, as :func:`ancillary` says."""


@dataclass(frozen=True)
class AncillaryController:
    """Proposer of samples beside those that are drawn; build one with :func:`ancillary`."""

    name: str
    function: Propose
    samples: int = 1
    """How many samples it proposes."""


def ancillary(name: str, *, samples: int = 1) -> Callable[[Propose], AncillaryController]:
    """Turn a function into an ancillary controller (Trevisan and Alonso-Mora 2024, 2401.09241).

    Before every plan the function is asked for controls to try from the observed state on. They are rolled out and
    weighed as other samples are, so that a bad proposal costs nothing but its place among them. A scene names it with
    ``planner.ancillary = [{ function = "name" }]``.

    It takes the observed :class:`~warpmpc.State`, the poses ``[7]`` and scalars of the task by name, and the times
    ``[T]`` after the observation at which the steps of a rollout begin [s]. It returns controls, one for all of them
    ``[nu]``, one for every step ``[T, nu]`` or knots ``[P, nu]``; with several ``samples`` n an array ``[n, T, nu]`` or
    ``[n, P, nu]``; or None, when there is nothing to propose.

    Args:
        name: What scene files call it.
        samples: How many samples it proposes.

    Raises:
        TypeError: If the name is none, or ``samples`` no number above zero.

    Example:
        >>> @warpmpc.ancillary("straight")
        ... def straight(state, task, times):
        ...     goal = task["goal"]
        ...     return 2.0 * (goal[:2] - state.joint_q[:2])
    """
    if not isinstance(name, str) or not name:
        raise TypeError(f'an ancillary controller has a name, not {name!r}: @warpmpc.ancillary("name")')
    if not isinstance(samples, int) or samples < 1:
        raise TypeError(f"ancillary controller '{name}': samples is 1 or more, not {samples!r}")
    return lambda function: AncillaryController(name, function, samples)
