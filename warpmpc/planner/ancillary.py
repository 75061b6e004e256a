# SPDX-License-Identifier: Apache-2.0
"""Proposers on the host, asked before every plan.

Policies as ONNX files, whose controls are tried among the samples.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..cost.user_files import place, raised_at
from ..scene.errors import SceneError
from ..scene.model.assets import resolve_asset
from ..scene.model.state import State
from .proposers import Proposer
from .recall import Recall, motions
from .splines import Ask, Horizon

if TYPE_CHECKING:
    from ..scene.model.layout import Layout
    from ..scene.schema import Ancillary, Scene
    from ..scene.task.task import AncillaryController, Task
    from .plan import PlanReport

FLOAT = "tensor(float)"
LONGEST = 10.0
"""Time for the first controls of a policy, which may have no end [s]."""


def policy(scene: Scene, layout: Layout, key: str, wanted: Ancillary, horizon: Horizon, task: Task) -> tuple[int, Ask]:
    """Number of samples that the policy of a file proposes, and the function that runs it.

    Raises:
        SceneError: If onnxruntime or the file is missing, or the policy reads or returns something else.
    """

    def wrong(message: str, **more: object) -> SceneError:
        return SceneError(message, key=key, file=scene.path, found=wanted.policy, **more)

    base = None if scene.path is None else scene.path.parent
    path = resolve_asset(wanted.policy, base=base, key=key, file=scene.path)
    try:
        import onnxruntime
    except ImportError:
        raise wrong('needs onnxruntime: pip install "warpmpc[onnx]"') from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # other cores roll out, and a policy is small
    options.log_severity_level = 4  # what it says is in the error
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of onnxruntime's own, derived from nothing else
        raise wrong(f"onnxruntime cannot read it: {' '.join(str(error).split())}") from None
    inputs = session.get_inputs()
    if len(inputs) != 1 or inputs[0].type != FLOAT:
        raise wrong(f"has the inputs {', '.join(f'{i.name} {i.type}' for i in inputs)}", allowed=f"one, {FLOAT}")
    _check_observation(scene, task, key.replace("policy", "observation"), wanted)
    (read,) = inputs
    width = len(_observation(wanted, State.start(layout), task.values(0)))
    if len(read.shape) not in (1, 2) or (isinstance(read.shape[-1], int) and read.shape[-1] != width):
        parts = " + ".join(wanted.observation)
        raise wrong(f"reads an array {read.shape}", allowed=f"[{width}] or [1, {width}], which is {parts}")

    running = onnxruntime.RunOptions()

    def run(state: State, values: Mapping[str, np.ndarray | float]) -> np.ndarray:
        observation = _observation(wanted, state, values)
        try:
            observation = observation.reshape((1,) * (len(read.shape) - 1) + (-1,))
            found = session.run(None, {read.name: observation}, running)[0]
        except Exception as error:
            raise wrong(f"onnxruntime cannot run it: {' '.join(str(error).split())}") from None
        return found[0] if len(read.shape) == 2 and np.ndim(found) > 1 and len(found) == 1 else found

    timer = threading.Timer(LONGEST, setattr, (running, "terminate", True))
    timer.start()
    try:
        first = run(State.start(layout), task.values(0))
    finally:
        timer.cancel()
    samples = len(first) if np.ndim(first) == 3 else 1
    try:
        horizon.proposed(first, samples)
    except (ValueError, TypeError) as error:
        raise wrong(str(error), allowed=horizon.allowed(1) + " or several of these") from None
    return samples, lambda state, values: horizon.proposed(run(state, values), samples)


def _check_observation(scene: Scene, task: Task, key: str, wanted: Ancillary) -> None:
    allowed = ["joint_q", "joint_qd", "act", *task.values(0)]
    for name in wanted.observation:
        if name not in allowed:
            raise SceneError("nothing that a policy can read", key=key, file=scene.path, found=name, allowed=allowed)


def _observation(wanted: Ancillary, state: State, values: Mapping[str, np.ndarray | float]) -> np.ndarray:
    known = {"joint_q": state.joint_q, "joint_qd": state.joint_qd, "act": state.act, **values}
    return np.concatenate([np.atleast_1d(known[name]) for name in wanted.observation]).astype(np.float32)


KEY = "planner.ancillary"


class Ancillaries:
    """All that a scene's ``planner.ancillary`` names.

    Args:
        knot_time: Times of the knots after the first ``[P]`` [s].
    """

    count: int
    """Number n of samples that they propose together."""

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        task: Task,
        knot_time: np.ndarray,
        controllers: Sequence[AncillaryController] = (),
    ):
        self._task, horizon = task, Horizon(scene, knot_time, layout.nu)
        self._proposers: list[Proposer] = []
        start = State.start(layout)
        for i, wanted in enumerate(scene.planner.ancillary):
            key = f"{KEY}[{i}]"
            if wanted.recall is not None:
                self._proposers.append(Recall(scene, layout, key, wanted, horizon, task.envs))
                continue
            if wanted.function is not None:
                made = _function(scene, f"{key}.function", wanted.function, controllers, horizon)
            elif wanted.motions is not None:
                made = motions(scene, layout, f"{key}.motions", wanted, horizon)
            else:
                made = policy(scene, layout, f"{key}.policy", wanted, horizon, task)
            proposed = made[1](start, task.values(0))
            if proposed is not None and not np.isfinite(proposed).all():
                kind = next(name for name in ("function", "motions", "policy") if getattr(wanted, name))
                found, message = getattr(wanted, kind), "proposes numbers that are not finite from the start state"
                raise SceneError(message, key=f"{key}.{kind}", file=scene.path, found=found)
            self._proposers.append(StatePolicy(*made))
        self._proposers.sort(key=lambda proposer: isinstance(proposer, Recall))
        self.count = sum(proposer.count for proposer in self._proposers)
        self._widths = np.cumsum([layout.nq, layout.nv, layout.na])
        self._knots = np.full((task.envs, self.count, len(knot_time), layout.nu), np.nan, dtype=np.float32)

    @property
    def columns(self) -> int:
        """Numbers of all knots that are proposed for one environment, n·P·nu."""
        return self._knots[0].size

    def reset(self) -> None:
        """Forget what is remembered of a run."""
        for proposer in self._proposers:
            proposer.reset()

    def __call__(self, observed: np.ndarray, time: np.ndarray, block: np.ndarray, last: PlanReport) -> np.ndarray:
        """Ask them all for every environment that is observed.

        Args:
            observed: Whether there is an observation to plan from ``[E]``.
            time: Its time ``[E]`` [s].
            block: Joint coordinates, joint velocities, activations, mocap poses ``[E, nq + nv + na + 7 nm]``.
            last: What came of the plan before, if there was one since the last reset.

        Returns:
            Knots ``[E, n·P·nu]``, not finite where there is nothing to propose.
        """
        self._knots[:] = np.nan
        for e in range(len(observed)) if self.count else ():
            state, task = None, {}
            if observed[e]:
                q, qd, act, mocap = np.split(block[e].copy(), self._widths)
                state, task = State(q, qd, float(time[e]), act, mocap.reshape(-1, 7)), self._task.values(e)
            first = 0
            for proposer in self._proposers:
                proposed = proposer.ask(e, state, task, last)
                if proposed is not None:
                    self._knots[e, first : first + len(proposed)] = proposed
                first += proposer.count
        return self._knots.reshape(len(self._knots), -1)


class StatePolicy(Proposer):
    """Samples that the observed state and the task alone decide.

    Args:
        policy: The knots for them.
    """

    def __init__(self, count: int, policy: Ask):
        super().__init__(count)
        self._policy = policy

    def ask(
        self, e: int, state: State | None, task: Mapping[str, np.ndarray | float], last: PlanReport
    ) -> np.ndarray | None:
        """Knots ``[n, P, nu]`` for one environment, None where there are none or they are not finite."""
        proposed = None if state is None else self._policy(state, task)
        return proposed if proposed is not None and np.isfinite(proposed).all() else None


def _function(
    scene: Scene, key: str, name: str, controllers: Sequence[AncillaryController], horizon: Horizon
) -> tuple[int, Ask]:
    known = {controller.name: controller for controller in controllers}
    if name not in known:
        message = "no such ancillary controller (your own ones come with --terms FILE.py)"
        raise SceneError(message, key=key, file=scene.path, found=name, allowed=known)
    controller, times = known[name], horizon.time.copy()
    times.setflags(write=False)

    def ask(state: State, task: Mapping[str, np.ndarray | float]) -> np.ndarray | None:
        try:
            controls = controller.function(state, task, times)
        except Exception as error:
            what = f"{raised_at(error, controller.function)}: {type(error).__name__}: {' '.join(str(error).split())}"
            raise SceneError(what, key=key, file=scene.path, found=name) from error
        if controls is None:
            return None
        try:
            return horizon.proposed(controls, controller.samples)
        except (ValueError, TypeError) as error:
            allowed, where = horizon.allowed(controller.samples), place(controller.function)
            raise SceneError(f"{where}: {error}", key=key, file=scene.path, found=name, allowed=allowed) from None

    return controller.samples, ask
