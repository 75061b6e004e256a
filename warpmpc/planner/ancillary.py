# SPDX-License-Identifier: Apache-2.0
"""What proposes samples beside those that are drawn, asked on the host before every plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..cost.blame import place, raised_at
from ..engine.timegrid import TimeGrid
from ..model.state import State
from ..scene.errors import SceneError
from .splines import SplineKind, fitting_matrix

if TYPE_CHECKING:
    from ..model.layout import Layout
    from ..scene.schema import Scene
    from ..task.ancillary import AncillaryController
    from ..task.task import Task
    from .graph import PlanReport
    from .recall import Recall

KEY = "planner.ancillary"

Ask = Callable[[State, Mapping[str, "np.ndarray | float"]], "np.ndarray | None"]
"""``(state, task) -> knots [n, P, nu]``, or None where there is nothing to propose."""


class Horizon:
    """Turns controls over the horizon into knots of a plan.

    Args:
        scene: The scene.
        knot_time: Times of the knots after the first ``[P]`` [s].
        nu: Number of controls.
    """

    def __init__(self, scene: Scene, knot_time: np.ndarray, nu: int):
        self.nu, self.knot_time, self.time = nu, knot_time, TimeGrid.of(scene).t[:-1]
        """Times at which the steps begin ``[T]`` [s]."""
        self.kind = SplineKind(scene.planner.spline.value)
        self._matrix = fitting_matrix(self.kind, knot_time, self.time)

    @property
    def shapes(self) -> list[str]:
        """What a sequence of controls may look like."""
        return [f"[{count}, {self.nu}]" for count in dict.fromkeys((len(self.time), len(self.knot_time)))]

    def knots(self, controls: np.ndarray) -> np.ndarray:
        """Knots ``[n, P, nu]`` of controls ``[n, T, nu]``, the nearest ones, or of knots as they are.

        Raises:
            ValueError: If they are neither.
        """
        if controls.ndim != 3 or controls.shape[2] != self.nu:
            raise ValueError
        if controls.shape[1] == len(self.knot_time):
            return controls
        if controls.shape[1] != len(self.time):
            raise ValueError
        return self._matrix @ controls

    def proposed(self, controls: object, samples: int) -> np.ndarray:
        """Knots ``[n, P, nu]`` of what a function or a policy returned.

        Args:
            controls: One control for the whole horizon ``[nu]``, or a sequence; a list of n of those where n is not 1.
            samples: How many are expected, n.

        Raises:
            ValueError: If it is nothing of the kind; the message says what it is.
        """
        values = np.asarray(controls, dtype=np.float64)
        if samples == 1 and values.shape == (self.nu,):
            values = np.broadcast_to(values, (len(self.knot_time), self.nu))
        if samples == 1 and values.ndim == 2:
            values = values[None]
        if len(values) != samples or values.ndim != 3:
            raise ValueError(f"returns an array {list(np.shape(controls))}")
        try:
            return self.knots(values)
        except ValueError:
            raise ValueError(f"returns an array {list(np.shape(controls))}") from None

    def allowed(self, samples: int) -> str:
        """What may be returned, in words."""
        if samples > 1:
            return " or ".join(f"[{samples}, {shape[1:]}" for shape in self.shapes)
        return " or ".join([f"[{self.nu}]", *self.shapes])


class Ancillaries:
    """All that a scene's ``planner.ancillary`` names.

    Args:
        scene: The scene.
        layout: Its layout.
        task: The task, of E environments.
        knot_time: Times of the knots after the first ``[P]`` [s].
        controllers: Users' own ancillary controllers.

    Raises:
        SceneError: If there is no such controller or file, or what it proposes at the start does not fit.
    """

    count: int
    """How many samples they propose together, n."""

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        task: Task,
        knot_time: np.ndarray,
        controllers: Sequence[AncillaryController] = (),
    ):
        from .motions import motions  # these know this module
        from .policy import policy
        from .recall import Recall

        self._task, horizon = task, Horizon(scene, knot_time, layout.nu)
        self._asked: list[tuple[int, Ask]] = []
        self._recalls: list[Recall] = []
        start = State.start(layout)
        for i, wanted in enumerate(scene.planner.ancillary):
            key = f"{KEY}[{i}]"
            if wanted.recall is not None:
                self._recalls.append(Recall(scene, layout, key, wanted, horizon, task.envs))
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
            self._asked.append(made)
        self.count = sum(count for count, _ in self._asked) + sum(recall.count for recall in self._recalls)
        self._widths = np.cumsum([layout.nq, layout.nv, layout.na])
        self._knots = np.full((task.envs, self.count, len(knot_time), layout.nu), np.nan, dtype=np.float32)

    @property
    def columns(self) -> int:
        """Numbers of all knots that are proposed for one environment, n·P·nu."""
        return self._knots[0].size

    def reset(self) -> None:
        """Forget what is remembered of a run."""
        for recall in self._recalls:
            recall.reset()

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
        for recall in self._recalls:
            recall.miss(~observed, last)
        for e in np.flatnonzero(observed) if self.count else ():
            q, qd, act, mocap = np.split(block[e].copy(), self._widths)
            state, task = State(q, qd, float(time[e]), act, mocap.reshape(-1, 7)), self._task.values(e)
            first = 0
            for count, ask in self._asked:
                proposed = ask(state, task)
                if proposed is not None and np.isfinite(proposed).all():
                    self._knots[e, first : first + count] = proposed
                first += count
            for recall in self._recalls:
                proposed = recall(e, state, last)
                self._knots[e, first : first + len(proposed)] = proposed
                first += recall.count
        return self._knots.reshape(len(self._knots), -1)


def _function(
    scene: Scene, key: str, name: str, controllers: Sequence[AncillaryController], horizon: Horizon
) -> tuple[int, Ask]:
    """A function of a user's own."""
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
