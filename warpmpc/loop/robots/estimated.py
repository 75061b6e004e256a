# SPDX-License-Identifier: Apache-2.0
"""A driver's robot with what a scene estimates from its measurements.

A driver's robot with the end of its run.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...scene.model.state import State
from ...scene.schema_estimate import Sensors
from ...scene.task.task import Task, task_layout
from ..estimation import base_estimator, scene_estimator
from ..estimation.measurement import KEPT, ImuMeasured, JointsMeasured, Measurement, PoseMeasured, thinned
from ..estimation.scene_estimator import SceneEstimator
from ..plant.monitor import Monitor
from ..realtime.watchdog import received
from .sources import Heard

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...planner.plan import Plan
    from ...scene.model.compiled import CompiledScene
    from ...scene.model.pairs import Pair
    from ...scene.schema import Scene
    from ...scene.task.goal import GoalError
    from ..realtime.loop import Robot

logger = logging.getLogger("warpmpc")

REPLAYED = 24
"""Measurements that are taken in again for a late one, at most."""
AHEAD = 0.25
"""Time by which a measurement may be ahead of the state [s]."""


@dataclass
class Source:
    """Measurements of one kind and thing."""

    heard: Heard
    """Those that came."""
    what: str
    """Name of one."""
    wrong: str
    """Fault of one that cannot be used, and the cure."""
    hold: float
    """Time for which an estimate goes on without one [s]."""
    newest: float = -np.inf
    """Time of the newest [s]."""


class EstimatedRobot:
    """A robot parts of whose state are estimated from measurements; everything else is the driver's.

    Where nothing was measured for longer than an estimate goes on without (``LONGEST`` of its filter), or an estimate
    cannot be trusted, the state's time stands still, so that the agent's watchdog sees an observation that is too old.
    A measurement that is ahead of the state by more than :data:`AHEAD`, or behind it by more than :data:`KEPT`, is
    refused; of too many at once some are left out. A state that goes back by more than :data:`KEPT` shows that a clock
    was set: everything is forgotten; where a base is estimated, what was measured has to go back, too. An inertial
    measurement unit that was silent for as long carries no estimate forward, nor does one whose clock was set: before
    the first command the robot is where the scene begins, as while the planner starts; after it, it is unknown where it
    is, the state stays old, and the run is over.

    Args:
        robot: Driver with ``measurements()``.
        scene: The scene, with what is estimated.
        compiled: The scene, compiled.

    Raises:
        SceneError: If something that is estimated does not exist or is not free.
    """

    def __init__(self, robot: Robot, scene: Scene, compiled: CompiledScene):
        measured = {"plant": scene.plant.model_copy(update={"sensor": Sensors()})}
        self._robot, self._estimator = robot, SceneEstimator(scene.model_copy(update=measured), compiled)
        for part in self._estimator.parts:
            part.history.most = REPLAYED
        self._sources: dict[tuple[str, type], Source] = {}
        for name in scene.estimate:
            wrong = "out of range or has no rotation: send x, y, z, qx, qy, qz, qw, and its time"
            heard = Heard(f"measured poses of {name}", "poses")
            self._sources[name, PoseMeasured] = Source(heard, "a pose", wrong, scene_estimator.LONGEST)
        for name in scene.estimate_base:
            for kind, content in ((ImuMeasured, "inertial measurement unit"), (JointsMeasured, "joints")):
                heard = Heard(f"{content} of {name}", "measurements")
                source = Source(
                    heard, "a measurement", "not finite, out of range or of the wrong size", base_estimator.LONGEST
                )
                self._sources[name, kind] = source
        self._state: State | None = None
        self._time = self._trusted = self._seen = -np.inf  # the last is the time of the driver's newest state
        self._bases = bool(scene.estimate_base)
        self._commanded = self._lost = False
        if hasattr(robot, "follow"):
            self.follow = self._follow

    def __getattr__(self, name: str) -> Any:
        """Everything that drivers may have besides."""
        return getattr(self._robot, name)

    def heard(self) -> list[Heard]:
        """The driver's sources, and measurements of each thing that is estimated."""
        return [*getattr(self._robot, "heard", list)(), *(source.heard for source in self._sources.values())]

    def observe(self) -> State | None:
        """The newest state as it is estimated, None before everything was measured."""
        state = self._robot.observe()
        state = None if state is None else received(state)
        if state is None or not np.isfinite(state.time):
            return None if self._state is None else state  # the watchdog reports it
        told = thinned(self._robot.measurements())
        silent, back = self._silence(told, state.time), state.time < self._time - KEPT
        if back and self._bases and not any(self._near(measured, state.time) for measured in told):
            return None if self._state is None else state  # its time alone is wrong, and the watchdog reports it
        if back or silent is not None:
            why = (
                "the clock was set back by" if silent is None else f"the unit or joints of {silent[0]} were silent for"
            )
            if self._bases and self._commanded and not self._lost:
                self._lost = True
                logger.error("%s over %g s: where the robot is is not known; run anew", why, KEPT)
            if not self._lost:
                self._estimator.reset()
                self._state = None
                self._time = self._trusted = -np.inf
                for source in self._sources.values():
                    source.newest = -np.inf
                told = told if silent is None else [measured for measured in told if measured.time >= silent[1]]
        if self._lost:
            return self._state
        for measurement in told:
            if (source := self._sources.get((measurement.name, type(measurement)))) is not None:
                self._take(source, measurement, state.time)
        until = min(source.newest + source.hold for source in self._sources.values())
        if until == -np.inf:
            return None
        self._time = min(state.time, until)
        if self._estimator.trusted(state.time):
            self._trusted = self._time
        if told or state.time != self._seen:
            self._state = replace(self._estimator.fill(state), time=min(self._time, self._trusted))
        self._seen = state.time
        return self._state

    @property
    def done(self) -> bool:
        """Return whether the run is over: when the pose of the robot is lost, or by the driver's own word."""
        return self._lost or bool(getattr(self._robot, "done", False))

    def apply(self, control: np.ndarray) -> None:
        """Send a control ``[nu]``."""
        self._commanded = True
        self._robot.apply(control)

    def _follow(self, plan: Plan, now: float) -> None:
        self._commanded = True
        self._robot.follow(plan, now)

    def _silence(self, told: list[Measurement], now: float) -> tuple[str, float] | None:
        """The robot whose unit was silent for too long, and when it spoke again [s]; None for none."""
        for (name, kind), source in self._sources.items():
            if kind is not ImuMeasured:
                continue
            own = [measured.time for measured in told if isinstance(measured, kind) and measured.name == name]
            known = [t for t in (source.newest, *own) if np.isfinite(t) and source.newest <= t <= now + AHEAD]
            known = np.sort(known)
            gaps = np.flatnonzero(np.diff(known) > KEPT)
            if len(gaps):
                return name, float(known[gaps[-1] + 1])
        return None

    def _near(self, measured: Measurement, time: float) -> bool:
        """Return whether a measurement of something that is estimated was made about a time [s]."""
        known = (measured.name, type(measured)) in self._sources
        return known and bool(np.size(measured.time) == 1 and -KEPT <= measured.time - time <= AHEAD)

    def _take(self, source: Source, measured: Measurement, now: float) -> None:
        """Take in a measurement that may be as its numbers and its time are; note it, or why it is refused."""
        heard, ahead = source.heard, measured.time - now
        if ahead > AHEAD:
            late = f"{ahead:.3f} s ahead of the robot's state: stamp both by the robot's clock"
            heard.refuse(f"{source.what} is {late}")
        elif ahead < -KEPT:
            heard.refuse(
                f"{source.what} is {-ahead:.3g} s older than the robot's state: stamp both by the robot's clock"
            )
        elif not self._estimator.update(measured):
            heard.refuse(f"{source.what} is {source.wrong}")
        else:
            source.newest = max(measured.time, source.newest)
            heard.note(source.newest)


SILENT = 3.0
"""Time without a new state from which on this host's clock counts, too [s]."""


class MonitoredRobot:
    """A driver's robot with the end of its run: success, failure, timeout, or what the driver's ``done`` says.

    Its last good observation stands where a simulated plant has its true state.

    Args:
        scene: The scene.
        robot: The robot.
        task: What the run wants, shared with the planner.
        terms: Users' own cost terms that success, failures or phases name.
        compiled: The scene compiled earlier, to save doing it again.

    Raises:
        SceneError: As :class:`~warpmpc.Monitor`.
    """

    mean_cost: float | None = None
    """None: cost terms are not evaluated on what a driver observes."""
    pairs: tuple[Pair, ...] = ()
    """None: contact forces are not observed."""
    forces = np.zeros((0, 3))
    """Forces on them ``[0, 3]``."""
    moves_when_observed = True
    """Its state is the last observation: it does not move on in :meth:`apply`, as a plant does."""

    def __init__(
        self, scene: Scene, robot: Robot, *, task: Task, terms: Sequence[UserTerm] = (), compiled: CompiledScene
    ):
        self.scene, self.robot, self.layout = scene, robot, task_layout(compiled.layout, scene)
        self.stop = getattr(robot, "stop", lambda: None)
        if hasattr(robot, "tell"):
            self.tell = robot.tell
        if hasattr(robot, "follow"):
            self.follow = self._follow
        # its kernels are loaded now: the first look would take many ticks
        Monitor(scene, task=Task(scene), terms=terms, compiled=compiled).update(State.start(self.layout), None)
        self._monitor = Monitor(scene, task=task, terms=terms, compiled=compiled)
        self._control: np.ndarray | None = None
        self._start: float | None = None
        self._stamp, self._came = math.nan, math.inf  # time of the newest state, and when it came, on this host
        self.state = State.start(self.layout)
        """The last observation that was finite and of the right size; the scene's start before."""
        self.time = 0.0
        """Time since the first observation [s]."""

    def observe(self) -> State | None:
        """The newest state, None before the first."""
        seen = self.robot.observe()
        if seen is None:
            return None
        state = received(seen)
        if not (self._fits(state) and np.isfinite(state.time)):
            return state  # the watchdog reports it
        self._start = state.time if self._start is None else self._start
        if state.time != self._stamp:
            self._stamp, self._came = state.time, time.monotonic()
        self.time = state.time - self._start
        self._monitor.update(state, self._control)
        if np.isfinite(state.joint_q).all() and np.isfinite(state.joint_qd).all():
            self.state = state
        return state

    def _fits(self, state: State) -> bool:
        """Return whether a state has the scene's numbers."""
        layout, mocap = self.layout, state.mocap
        joints = (state.joint_q.shape, state.joint_qd.shape) == ((layout.nq,), (layout.nv,))
        return joints and (mocap is None or mocap.shape == (layout.nm, 7))

    @property
    def body_q(self) -> np.ndarray:
        """Poses of all bodies ``[nb, 7]``, as the joints have them; NaN before the first observation."""
        found = self._monitor.body_q
        return np.full((self.layout.nb, 7), np.nan) if found is None else found

    @property
    def error(self) -> GoalError | None:
        """Distance of the goal's object or frame from the goal; None for a scene without a goal."""
        return self._monitor.error

    def apply(self, control: np.ndarray) -> None:
        """Send a control ``[nu]``."""
        self._control = control.copy()
        self.robot.apply(control)

    def _follow(self, plan: Plan, now: float) -> None:
        self._control = plan.at(now)
        self.robot.follow(plan, now)

    @property
    def success(self) -> bool:
        """Return whether what is wanted holds and did so long enough."""
        return self._monitor.success

    @property
    def done(self) -> bool:
        """Return whether the run is over."""
        return self.reason != "running"

    @property
    def reason(self) -> str:
        """A few words about how the run ended, ``running`` until then."""
        if self.success:
            return "goal reached"
        if self._monitor.failure is not None:
            return f"failed: {self._monitor.failure}"
        silence = time.monotonic() - self._came
        if self.time + (silence if silence > SILENT else 0.0) >= self.scene.timing.timeout:
            return "timeout"
        return "ended by the robot" if getattr(self.robot, "done", False) else "running"
