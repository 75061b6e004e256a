# SPDX-License-Identifier: Apache-2.0
"""Samples that are not drawn: null particles, the best samples so far, sequences of a file, proposals of the host.

Control sequences from a file, as knots of a plan.

Rows that go straight to postures in which a frame is where it is wanted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..engine.protocol import TimeGrid
from ..kernels.planner.postures import Reach, posture_rows_kernel, replace_posture_kernel, search_posture_kernel
from ..kernels.planner.sampling import advance_counter_kernel
from ..physics.runtime.files import read_npz
from ..physics.runtime.launch import Launcher
from ..scene.errors import SceneError
from ..scene.model.assets import resolve_asset
from ..scene.model.joints import chain, chain_axes, driving, joint_table
from ..scene.model.layout import GOAL
from .splines import fitted_knots

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from ..kernels.planner.splines import Spline
    from ..scene.model.layout import Layout
    from ..scene.model.state import State
    from ..scene.schema import Scene
    from ..scene.task.observed import ObservedState
    from .plan import PlanReport


class Proposer:
    """One or more samples of every plan that are not drawn; they are clamped to the limits when they are tried.

    A proposer on the device writes :attr:`knots` in :meth:`before_plan`. One on the host is asked before that; its
    answer travels with the observation (:class:`~.ancillary.Ancillaries`, :class:`LaunchedSamples`).

    Args:
        count: Number of samples.
    """

    knots: wp.array4d[float]
    """Knots ``[count, E, P, nu]``, on the device."""

    def __init__(self, count: int):
        self.count = count

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots to write."""
        self.knots = knots

    def before_plan(self) -> None:
        """Write the knots for the state that is observed now, once the plan has moved on; capture-safe."""

    def ask(
        self, e: int, state: State | None, task: Mapping[str, np.ndarray | float], last: PlanReport
    ) -> np.ndarray | None:
        """Knots ``[n, P, nu]`` for one environment, n at most :attr:`count`; not finite, or None, for a null particle.

        Args:
            state: Its observed state; None where there is none, and nothing is proposed.
            last: What came of the plan before this one, if there was one since the last reset.
        """

    def reset(self) -> None:
        """Forget earlier plans."""


class LaunchedSamples(Proposer):
    """Samples that one kernel writes for the state that is observed now, a thread for each knot.

    Args:
        kernel: ``null_rows_kernel``, for null particles (the observed position, or what holds the start), or
            ``proposed_rows_kernel``, for answers of the host's proposers, null particles where there is none.
        inputs: Its inputs.
    """

    def __init__(self, count: int, kernel: wp.Kernel, inputs: Sequence[wp.array]):
        super().__init__(count)
        self._kernel, self._inputs, self._launch = kernel, list(inputs), Launcher(inputs[0].device)

    def before_plan(self) -> None:
        """Launch the kernel; capture-safe."""
        self._launch(self._kernel, self.knots.shape[:3], self._inputs, [self.knots])


class BestSamples(Proposer):
    """The best samples so far, which move on with the plan, the best one first.

    Args:
        carry: Lets knots ``[E, P, nu]`` move on with the plan.
    """

    def __init__(self, carry: Callable[[wp.array], None], count: int):
        super().__init__(count)
        self._carry = carry

    def bind(self, knots: wp.array4d[float]) -> None:
        """Take the knots to write, which move on with the plan from now on."""
        super().bind(knots)
        for row in range(len(knots)):
            self._carry(knots[row])


class StoredSamples(Proposer):
    """Sequences of a file, the same at every plan.

    Args:
        sequences: Their knots ``[n, P, nu]``.
    """

    def __init__(self, sequences: np.ndarray):
        super().__init__(len(sequences))
        self._sequences = sequences

    def bind(self, knots: wp.array4d[float]) -> None:
        """Fill the knots, once and for all."""
        super().bind(knots)
        knots.assign(np.broadcast_to(self._sequences[:, None], knots.shape).astype(np.float32))


KEY = "planner.sequences"


def sequences(scene: Scene, knot_time: np.ndarray, nu: int) -> np.ndarray:
    """The sequences of a scene's file as knots ``[n, P, nu]``, none without one.

    A sequence has a control for every knot, or for every step of a rollout: then its knots are those whose spline
    comes nearest to it in the least-squares sense, which is the sequence itself where there are as many knots as steps.

    Args:
        knot_time: Times of the knots after the first ``[P]`` [s].

    Raises:
        SceneError: If the file is missing, cannot be read or has the wrong shape.
    """
    name = scene.planner.sequences
    if name is None:
        return np.zeros((0, len(knot_time), nu), dtype=np.float32)
    base = None if scene.path is None else scene.path.parent
    path = resolve_asset(name, base=base, key=KEY, file=scene.path)
    values = _read(path, scene)
    grid, knots = TimeGrid.of(scene), len(knot_time)
    counts = dict.fromkeys((grid.steps, knots))
    if values.ndim == 2 and path.suffix == ".csv":
        lengths = [count for count in counts if count * nu == values.shape[1]]
        values = values.reshape(len(values), -1, nu) if lengths else values
    if values.ndim != 3 or not len(values) or values.shape[1] not in counts or values.shape[2] != nu:
        shapes = [f"[n, {count}, {nu}]" for count in counts]
        if path.suffix == ".csv":
            shapes = [f"lines of {count * nu} numbers" for count in counts]
        raise _error(scene, f"has the shape {list(values.shape)}", allowed=" or ".join(shapes))
    if not np.all(np.isfinite(values)):
        raise _error(scene, "has numbers that are not finite")
    if values.shape[1] == knots:
        return values.astype(np.float32)
    return fitted_knots(scene.planner.spline, knot_time, values, grid.t[:-1])


def _read(path: Path, scene: Scene) -> np.ndarray:
    try:
        match path.suffix:
            case ".npy":
                values = np.load(path, allow_pickle=False)
            case ".csv":
                values = np.loadtxt(path, delimiter=",", ndmin=2)
            case ".npz":
                with read_npz(path) as arrays:
                    if len(arrays.files) != 1:
                        raise _error(scene, f"holds {len(arrays.files)} arrays, not one")
                    values = arrays[arrays.files[0]]
            case _:
                raise _error(scene, "is no file of arrays", allowed=[".csv", ".npy", ".npz"])
        return np.asarray(values, dtype=np.float64)
    except SceneError:
        raise
    except (OSError, ValueError, TypeError, EOFError, MemoryError, OverflowError) as error:
        raise _error(scene, f"cannot be read as numbers: {error}") from error


def _error(scene: Scene, message: str, allowed: object = None) -> SceneError:
    return SceneError(message, key=KEY, file=scene.path, found=scene.planner.sequences, allowed=allowed)


POSTURES_KEY = "planner.postures"
MODES = ("position", "velocity", "acceleration")
"""Modes of a control, by how often the way is differentiated."""
DAMPING = 1e-3
"""Added to J Jᵀ; its squared lengths are in metres and radians."""
NEAR = 0.01
"""Largest error of a posture's pose [m and rad]."""
STRIDE, STEPS = 0.5, 3
"""Greatest change of a joint in a step of the search [m or rad], and steps in every plan."""
MIN_AGE = 12
"""Plans for which a posture stays at least, before it may make room for another."""
MARGIN = 0.05
"""Share of the range of every joint that postures keep away from its limits, both ends together."""


class PostureSamples(Proposer):
    """Samples that go to postures which bring a frame to a pose of the task, each posture at several paces.

    Postures are searched for on the way, a little in every plan, and tried once they have found the pose: what their
    rows cost ranks them, and the worst of those that have had time to get there makes room for one begun at random.
    Where there is none, as for a pose out of reach, these rows ask for nothing.

    Args:
        scene: The scene, whose ``planner.postures`` says what is wanted.
        null: Controls that ask for nothing in the observed state ``[E, nu]``.
        cost: Costs of the samples ``[E, S]``.
        first: The sample that the first row is.
        seed: Seed of the postures that are begun.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        state: ObservedState,
        spline: Spline,
        null: wp.array,
        cost: wp.array,
        *,
        first: int,
        seed: int,
    ):
        wanted, device, envs = scene.planner.postures, cost.device, cost.shape[0]
        super().__init__(wanted.count * len(wanted.durations))
        self._state, self._null, self._cost, self._first, self._seed = state, null, cost, first, seed
        self._time = spline.time
        self._launch, postures = Launcher(device), envs * wanted.count
        self._reach = _reach(scene, layout, postures, str(device))
        self._duration = wp.array(wanted.durations, dtype=float, device=device)
        self.postures = wp.array(np.tile(layout.joint_q, (1, postures, 1)), dtype=float, device=device)
        """The postures as joint coordinates ``[1, E·M, nq]``."""
        self._body_q = wp.zeros((1, postures, layout.nb), dtype=wp.transform, device=device)
        self._jacobian = wp.zeros((postures, len(self._reach.control)), dtype=wp.spatial_vector, device=device)
        self._miss = wp.zeros((envs, wanted.count), dtype=float, device=device)
        self._age = wp.zeros((envs, wanted.count), dtype=int, device=device)
        self._counter = wp.zeros(envs, dtype=int, device=device)
        self.reset()

    def reset(self) -> None:
        """Forget all postures; capture-safe."""
        self._counter.zero_()
        self._age.fill_(-1)

    def before_plan(self) -> None:
        """Search on, and write the ways to what was found; capture-safe."""
        state, reach, observed = self._state, self._reach, self._state.observed
        envs, count = self._age.shape
        self._launch(advance_counter_kernel, envs, [observed], [self._counter])
        replaced = [observed, self._cost, self._first, len(self._duration), MIN_AGE, NEAR, self._miss]
        self._launch(replace_posture_kernel, envs, replaced, [self._age])
        inputs = [observed, state.joint_q, state.pose, reach, self._age, self._counter, self._seed]
        self._launch(
            search_posture_kernel,
            envs * count,
            [*inputs, STEPS, DAMPING, STRIDE],
            [self.postures, self._miss, self._body_q, self._jacobian],
        )
        found = [reach, self.postures, NEAR, self._miss, self._duration, self._time]
        inputs = [state.joint_q, state.joint_qd, self._null, *found]
        self._launch(posture_rows_kernel, (self.count, envs), inputs, [self.knots])


def _reach(scene: Scene, layout: Layout, worlds: int, device: str) -> Reach:
    wanted = scene.planner.postures
    of, to = (layout.frame(getattr(wanted, key), key=f"{POSTURES_KEY}.{key}") for key in ("of", "to"))
    body, target = int(layout.frame_body[of]), int(layout.frame_body[to])
    if target > GOAL:
        raise SceneError("is neither the goal nor a target", key=f"{POSTURES_KEY}.to", file=scene.path, found=wanted.to)
    try:
        axes = chain_axes(layout, body)[::-1]
    except ValueError as error:
        message = "a ball joint moves this frame; it does not turn about fixed axes"
        raise SceneError(message, key=f"{POSTURES_KEY}.of", file=scene.path, found=str(error)) from None
    controls = np.array([driving(layout, np.array(axes, dtype=int), mode) for mode in MODES])
    driven = np.flatnonzero(controls.max(axis=0) >= 0)
    if not len(driven):
        raise SceneError("no drive moves this frame", key=f"{POSTURES_KEY}.of", file=scene.path, found=wanted.of)
    columns = [axes[i] for i in driven]
    lower, upper = (limit[columns].astype(np.float64) for limit in (layout.dof_lower, layout.dof_upper))
    # a joint without limits turns once around, or slides a metre, from where it starts
    start = layout.joint_q[layout.dof_coord[columns]]
    free = upper - lower > 1e3
    lower, upper = np.where(free, start - np.pi, lower), np.where(free, start + np.pi, upper)
    inset = 0.5 * MARGIN * (upper - lower)

    def array(values: object, dtype: type) -> wp.array:
        return wp.array(np.asarray(values), dtype=dtype, device=device)

    r = Reach()
    r.table, r.chain = joint_table(layout, device, worlds=worlds), chain(layout, body, columns, device)
    r.joint, r.tip = array(_path(layout, body), int), body
    r.frame, r.target = wp.transform(*layout.frame_pose[of]), wp.transform(*layout.frame_pose[to])
    r.pose = GOAL - target
    r.lower, r.upper = array(lower + inset, float), array(upper - inset, float)
    r.control, r.order = array(controls.max(axis=0)[driven], int), array(controls.argmax(axis=0)[driven], int)
    r.dof = array(columns, int)
    return r


def _path(layout: Layout, body: int) -> list[int]:
    joint_of = {int(child): joint for joint, child in enumerate(layout.joint_child)}
    joints: list[int] = []
    while body >= 0:
        joints.append(joint_of[body])
        body = int(layout.joint_parent[joints[-1]])
    return joints[::-1]
