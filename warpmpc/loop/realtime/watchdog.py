# SPDX-License-Identifier: Apache-2.0
"""Checks of observations and plans, and limits of what the robot is sent.

Safe commands of a robot's drives, while nothing else commands it.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...scene.errors import SceneError
from ...scene.model.compiled import compile_scene
from ...scene.model.control_values import safe_command
from ...scene.model.conversion import MujocoStates
from ...scene.model.mujoco_model import make_world
from ...scene.model.state import State
from ...scene.schema import SafeCommand
from .messages import TimedPlan

if TYPE_CHECKING:
    from ...scene.model.compiled import CompiledScene
    from ...scene.model.layout import Layout
    from ...scene.schema import Scene


class FaultKind(StrEnum):
    """Kinds of faults."""

    OBSERVATION_INVALID = "observation not finite or of the wrong size"
    OBSERVATION_OLD = "old observation"
    OBSERVATION_FROZEN = "frozen observation"
    OBSERVATION_BACK = "observation back in time"
    OBSERVATION_AHEAD = "observation ahead of the clock"
    PLAN_MISSING = "no fresh plan"
    PLAN_DIVERGED = "every rollout diverged"
    PLAN_INVALID = "plan not finite or out of range"


Finding = tuple[FaultKind, str]
"""Kind of fault, and a sentence about it."""
MOVING = 1e-3
"""Joint velocity above which joint positions must change [m/s or rad/s]."""
BEYOND = 1e-3
"""Share of its range by which a control may miss its limits: rounding."""
SLACK = 1e-6
"""Tolerance of lapses of time [s]: times are sums of ticks."""


def received(state: State) -> State:
    """A copy of an observation, for drivers use their arrays again; what is no number in it is NaN."""
    act, mocap = (None if part is None else _numbers(part) for part in (state.act, state.mocap))
    time = _numbers(state.time)
    moment = float(time.reshape(())) if time.size == 1 else np.nan
    return State(_numbers(state.joint_q), _numbers(state.joint_qd), time=moment, act=act, mocap=mocap)


def _numbers(part: object) -> np.ndarray:
    try:
        found = np.array(part)
        return found if found.dtype.kind in "fiu" else found.astype(float)
    except (TypeError, ValueError):  # rows of several lengths, words
        return np.array(np.nan)


class Watchdog:
    """Looks at every observation, every plan and every command.

    Args:
        scene: The scene, whose ``agent`` says how old things may be.
        layout: State layout.
    """

    state: State | None
    """The last observation that could be trusted."""

    def __init__(self, scene: Scene, layout: Layout):
        self._settings, self._layout = scene.agent, layout
        self._shapes = {"joint_q": (layout.nq,), "joint_qd": (layout.nv,), "act": (layout.na,), "mocap": (layout.nm, 7)}
        beyond = BEYOND * (layout.control_upper - layout.control_lower)
        self._lower, self._upper = layout.control_lower - beyond, layout.control_upper + beyond
        self.state = None
        self._newest = -np.inf  # largest time of an observation
        self._moved = -np.inf  # when joint positions changed last, on the robot's clock
        self._joint_q: np.ndarray | None = None

    def observation_fault(self, state: State, now: float) -> Finding | None:
        """Return why an observation cannot be trusted, None where it can.

        Args:
            state: The observation, with its time, as :func:`received`: it is remembered.
            now: The robot's clock [s].
        """
        fault = self._observation_fault(state, now)
        self.state = state if fault is None else self.state
        return fault

    def _observation_fault(self, state: State, now: float) -> Finding | None:
        limit = self._settings.observation_timeout + SLACK
        for name, shape in self._shapes.items():
            part = getattr(state, name)
            if part is None:
                continue
            if np.shape(part) != shape:
                why = f"the observation's {name} is {list(np.shape(part))}, not {list(shape)}"
                return FaultKind.OBSERVATION_INVALID, why
            if not np.isfinite(part).all():
                return FaultKind.OBSERVATION_INVALID, "the observation is not finite"
        if not np.isfinite(state.time):
            return FaultKind.OBSERVATION_INVALID, "the observation has no finite time"
        if now < self._newest:  # the clock was set
            self._newest, self._moved = -np.inf, now
        age, back = now - state.time, self._newest - state.time
        if not age >= -SLACK:
            return FaultKind.OBSERVATION_AHEAD, f"the observation is {-age:.3f} s ahead of the clock"
        if back > SLACK:
            return FaultKind.OBSERVATION_BACK, f"the observation went back in time by {back:.3f} s"
        self._newest = state.time
        if not age <= limit:
            return FaultKind.OBSERVATION_OLD, f"the observation is {age:.3f} s old"
        if self._joint_q is None or not np.array_equal(state.joint_q, self._joint_q):
            self._joint_q, self._moved = state.joint_q, now
        if now - self._moved > limit and np.max(np.abs(state.joint_qd), initial=0.0) > MOVING:
            return (
                FaultKind.OBSERVATION_FROZEN,
                f"the observation is frozen: moving joints are {now - self._moved:.3f} s where they were",
            )
        return None

    def plan_fault(self, timed: TimedPlan | None, now: float) -> Finding | None:
        """Return why a plan is not to be followed, None where it is.

        Args:
            timed: The newest plan, None before the first.
            now: The robot's clock [s].
        """
        if timed is None:
            return FaultKind.PLAN_MISSING, "there is no plan yet"
        if not timed.survived:
            return FaultKind.PLAN_DIVERGED, "every rollout diverged"
        age, limit, plan = now - timed.observed, self._settings.plan_timeout + SLACK, timed.plan
        if not age >= -SLACK:
            return FaultKind.PLAN_INVALID, f"the plan is from what will be observed in {-age:.3f} s"
        if not age <= limit:  # whether it came long ago or took long to make
            return FaultKind.PLAN_MISSING, f"the newest plan is from what was observed {age:.3f} s ago"
        if not len(plan.times) or np.shape(plan.knots) != (len(plan.times), len(self._lower)):
            return (
                FaultKind.PLAN_INVALID,
                f"the plan has {len(plan.times)} times and knots {list(np.shape(plan.knots))}",
            )
        if not np.isfinite(plan.times).all():
            return FaultKind.PLAN_INVALID, "the plan is not finite"
        begins = plan.times[0] - now  # a little from now where it was made sooner than expected
        if not begins <= limit:
            return FaultKind.PLAN_INVALID, f"the plan begins in {begins:.3f} s"
        return self._controls_fault(plan.knots, "plan")

    def command_fault(self, control: np.ndarray) -> Finding | None:
        """Return why a plan's command ``[nu]`` is not to be sent, None where it is."""
        return self._controls_fault(control[None], "plan's command")

    def _controls_fault(self, controls: np.ndarray, what: str) -> Finding | None:
        """Return why controls ``[N, nu]`` are not valid for this robot."""
        if not np.isfinite(controls).all():
            return FaultKind.PLAN_INVALID, f"the {what} is not finite"
        outside = (controls < self._lower) | (controls > self._upper)
        if outside.any():
            row, column = np.argwhere(outside)[0]
            name, value = self._layout.control_name[column], controls[row, column]
            return FaultKind.PLAN_INVALID, f"the {what} is out of range: {name} = {value:.4g}"
        return None


class Bounds:
    """Limits of controls and of how fast they change: the last that every command goes through.

    Args:
        scene: The scene, whose ``agent.slew`` says how fast.
        layout: State layout.

    Raises:
        SceneError: If ``agent.slew`` has neither one value nor one per control.
    """

    def __init__(self, scene: Scene, layout: Layout):
        slew = scene.agent.slew
        if slew is not None and len(slew) not in (1, layout.nu):
            message = f"needs one value or {layout.nu}, one per control"
            raise SceneError(message, key="agent.slew", file=scene.path, found=list(slew))
        self._step = None if slew is None else np.broadcast_to(slew, layout.nu) / scene.agent.rate
        self._lower, self._upper = layout.control_lower, layout.control_upper
        self._last: np.ndarray | None = None

    def __call__(self, control: np.ndarray) -> np.ndarray:
        """The control ``[nu]`` that may be sent in place of another; one that is not finite is the one before."""
        if not np.isfinite(control).all():
            control = np.zeros_like(self._lower) if self._last is None else self._last
        control = self.clip(control)
        if self._step is not None and self._last is not None:
            control = np.clip(control, self._last - self._step, self._last + self._step)
        self._last = np.asarray(control, dtype=np.float32)
        return self._last.copy()

    def clip(self, control: np.ndarray) -> np.ndarray:
        """A control ``[nu]`` inside its limits."""
        return np.clip(control, self._lower, self._upper).astype(np.float32)


_MOTOR = (
    int(mujoco.mjtTrn.mjTRN_JOINT),
    int(mujoco.mjtGain.mjGAIN_FIXED),
    int(mujoco.mjtBias.mjBIAS_NONE),
    int(mujoco.mjtDyn.mjDYN_NONE),
)
"""Transmission, gain, bias and dynamics of a motor."""
_ONE_DOF = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))


class Gravity:
    """Efforts that balance gravity and springs, by MuJoCo's inverse dynamics at rest: ``qfrc_bias - qfrc_passive``.

    Controls are efforts where a motor (a fixed gain, no bias, no activation state) drives a joint of one degree of
    freedom. Contacts are left out, and so is whatever moves.

    Args:
        scene: The scene.
        compiled: The scene, compiled.

    Raises:
        SceneError: If no control is an effort.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene):
        world = make_world(compiled, timestep=scene.timing.control_dt)
        model = self._model = world.model
        self._data, self._states = mujoco.MjData(model), MujocoStates(compiled, model)
        found: dict[int, tuple[int, float, float]] = {}  # velocity coordinate → control, effort of one, offset
        for a in range(model.nu):
            columns = np.flatnonzero(world.actuator_matrix[a])
            if not _is_motor(model, a) or len(columns) != 1:
                continue
            each = float(model.actuator_gear[a, 0] * model.actuator_gainprm[a, 0])
            dof, factor = int(model.jnt_dofadr[model.actuator_trnid[a, 0]]), world.actuator_matrix[a, columns[0]]
            found.setdefault(dof, (int(columns[0]), each * factor, each * world.actuator_offset[a]))
        if not found:
            message = "no control of this scene is an effort: leave it out, drives hold or stop by themselves"
            raise SceneError(message, key="agent.safe", file=scene.path, found="gravity")
        self._dof = np.array(list(found))
        self._control = np.array([control for control, _, _ in found.values()])
        self._each = np.array([each for _, each, _ in found.values()])
        self._offset = np.array([offset for _, _, offset in found.values()])

    def __call__(self, state: State, control: np.ndarray) -> np.ndarray:
        """A control ``[nu]`` whose efforts are those that hold the robot.

        Args:
            state: Where the robot is, of one environment.
            control: What the other controls are.
        """
        model, data = self._model, self._data
        self._states.write(state, data)
        data.qvel[:] = 0.0
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        effort = (data.qfrc_bias - data.qfrc_passive)[self._dof]
        held = control.copy()
        held[self._control] = (effort - self._offset) / self._each
        return held


def _is_motor(model: mujoco.MjModel, a: int) -> bool:
    """Return whether an actuator's control is an effort along a joint of one degree of freedom."""
    kinds = (model.actuator_trntype, model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype)
    if tuple(int(kind[a]) for kind in kinds) != _MOTOR:
        return False
    straight = int(model.jnt_type[model.actuator_trnid[a, 0]]) in _ONE_DOF
    return straight and model.actuator_gear[a, 0] * model.actuator_gainprm[a, 0] != 0.0


class SafeCommands:
    """Commands that hold, brake or rest, as each drive is; limits are the caller's.

    Args:
        scene: The scene.
        layout: State layout.

    Raises:
        SceneError: If gravity is to be balanced in a scene without efforts.
    """

    def __init__(self, scene: Scene, layout: Layout):
        self._layout, self._dt = layout, scene.timing.control_dt
        balanced = scene.agent.safe is SafeCommand.GRAVITY
        self._gravity = Gravity(scene, compile_scene(scene)) if balanced else None
        self._held: State | None = None

    def release(self) -> None:
        """Take note that commands arrive again."""
        self._held = None

    def __call__(self, state: State, now: float) -> np.ndarray:
        """The control ``[nu]``: holds are where it was first asked for, brakes act while the robot is known to move.

        Args:
            state: The newest state that can be trusted, with its time.
            now: The robot's clock [s].
        """
        if self._held is None:
            self._held = state
        velocity = state.joint_qd if now - state.time < self._dt else np.zeros_like(state.joint_qd)
        safe = safe_command(self._layout, self._held.joint_q[None], velocity[None], self._dt)[0]
        return safe if self._gravity is None else self._gravity(state, safe)
