# SPDX-License-Identifier: Apache-2.0
"""A closed-loop run as arrays, and as files of them: CSV and NPZ."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model.npz import read_npz
from ..realtime.real_time_log import RealTimeLog
from .files import replacing
from .plan_log import PlanLog, PlanLogger
from .tick_log import TickLog

if TYPE_CHECKING:
    from ..controller.controller import Controller
    from ..model.layout import Layout
    from ..plant.plant import Plant
    from ..scene.schema import Scene

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
FORCE = ("x", "y", "z")
FILES = (".csv", ".npz")


@dataclass(frozen=True, kw_only=True)
class History:
    """One closed-loop run of N controls: N + 1 states of the plant, and the N plans made in all but the last of them.

    Row n of what belongs to plans was planned in state n and led to state n + 1. States are true ones, not observed
    ones. ``nq`` joint coordinates, ``nv`` joint velocities, ``nb`` bodies, ``nu`` controls, K cost terms, and contact
    forces of C pairs. Quaternions are x, y, z, w; free-joint twists are of the centre of mass.
    """

    time: np.ndarray
    """Simulated time of the states ``[N+1]`` [s]."""
    joint_q: np.ndarray
    """Joint coordinates ``[N+1, nq]`` [m, rad]."""
    joint_qd: np.ndarray
    """Joint velocities ``[N+1, nv]`` [m/s, rad/s]."""
    body_q: np.ndarray
    """Poses of bodies in the world ``[N+1, nb, 7]``."""
    contact_force: np.ndarray
    """Net force on the first of a pair at the last physics step before each state ``[N+1, C, 3]`` [N];
    NaN at the start."""
    control: np.ndarray
    """Controls applied ``[N, nu]``, in the drives' units."""
    cost: np.ndarray
    """Cost of the plan's best sample ``[N]``."""
    cost_terms: np.ndarray
    """What each term adds to it, with its weight and discounted ``[N, K]``."""
    plan_ms: np.ndarray
    """Wall time of the plan ``[N]`` [ms]."""
    beta: np.ndarray
    """Temperature β that weighed the samples next time ``[N]``."""
    eta: np.ndarray
    """Effective number of samples η ``[N]``."""
    goal_error: np.ndarray
    """How far the goal is, in each of R ways ``[N+1, R]`` [m, rad]."""
    joint_q_names: tuple[str, ...]
    """``[nq]``: ``robot/joint``, and ``.../x`` to ``.../qw`` for bodies that move freely."""
    joint_qd_names: tuple[str, ...]
    """``[nv]``: ``robot/joint``, and ``.../vx`` to ``.../wz`` for bodies that move freely."""
    body_names: tuple[str, ...]
    control_names: tuple[str, ...]
    term_names: tuple[str, ...]
    """Names of the cost terms ``[K]``, as ``info.terms`` has them."""
    pair_names: tuple[str, ...]
    """``first-second`` of each watched pair ``[C]``."""
    error_names: tuple[str, ...]
    """``position``, and ``yaw`` or ``rotation`` where they count ``[R]``; empty without a goal."""
    log: PlanLog | None = None
    """What the plans were made from, for :func:`warpmpc.replay`; None in files of older versions and in real time."""
    ticks: TickLog | None = None
    """What the agent did in real time, where each row is a tick; None elsewhere."""
    made: RealTimeLog | None = None
    """What the plans in real time were made from, for :func:`warpmpc.replay_real_time`; None where it was not kept."""

    def columns(self) -> dict[str, np.ndarray]:
        """Everything as columns of N + 1 numbers by name; plans, which the last state lacks, are NaN there.

        Names are ``time``, ``joint_q/NAME``, ``joint_qd/NAME``, ``body_q/NAME/x`` to ``/qw``,
        ``contact_force/NAME/x`` to ``/z``, ``control/NAME``, ``cost``, ``cost/NAME`` of each term, ``plan_ms``,
        ``beta``, ``eta``, ``goal_error/NAME``.
        """
        bodies = [f"body_q/{name}/{axis}" for name in self.body_names for axis in POSE]
        forces = [f"contact_force/{name}/{axis}" for name in self.pair_names for axis in FORCE]
        parts: list[tuple[list[str], np.ndarray]] = [
            (["time"], self.time[:, None]),
            ([f"joint_q/{name}" for name in self.joint_q_names], self.joint_q),
            ([f"joint_qd/{name}" for name in self.joint_qd_names], self.joint_qd),
            (bodies, self.body_q.reshape(len(self.time), -1)),
            (forces, self.contact_force.reshape(len(self.time), -1)),
            ([f"control/{name}" for name in self.control_names], self.control),
            (["cost"], self.cost[:, None]),
            ([f"cost/{name}" for name in self.term_names], self.cost_terms),
            (["plan_ms", "beta", "eta"], np.stack([self.plan_ms, self.beta, self.eta], axis=1)),
            ([f"goal_error/{name}" for name in self.error_names], self.goal_error),
        ]
        rows = len(self.time)
        return {
            name: np.concatenate([table[:, i], np.full(rows - len(table), np.nan)])
            for names, table in parts
            for i, name in enumerate(names)
        }

    def save(self, path: str | Path) -> None:
        """Write a file: ``.csv``, the :meth:`columns` with empty cells for NaN, or ``.npz``, the fields by their names.

        A file that is there is replaced when the new one is whole, and stays as it is where that fails.

        Raises:
            ValueError: If the file's name ends in neither.
            OSError: If it cannot be written.
        """
        path = history_file(path)
        if path.suffix == ".npz":
            arrays = {name: np.array(getattr(self, name)) for name in NAMES}
            with replacing(path, "wb") as file:
                np.savez_compressed(file, **arrays, **self._logs())
            return
        columns = self.columns()
        with replacing(path, encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            for row in zip(*(column.tolist() for column in columns.values()), strict=True):
                writer.writerow(["" if value != value else f"{value:.9g}" for value in row])

    def _logs(self) -> dict[str, np.ndarray]:
        """The logs as arrays."""
        logs = [log for log in (self.log, self.ticks, self.made) if log is not None]
        return {name: array for log in logs for name, array in log.to_arrays().items()}

    @classmethod
    def load(cls, path: str | Path) -> History:
        """Read an ``.npz`` file that :meth:`save` wrote; what older versions did not keep is NaN or missing.

        Raises:
            ValueError: If it is something else.
            OSError: If it cannot be read.
        """
        try:
            with read_npz(path) as data:
                plans, states = len(data["control"]), len(data["time"])
                later = {"beta": np.full(plans, np.nan), "eta": np.full(plans, np.nan)}
                later |= {"goal_error": np.zeros((states, 0)), "error_names": np.zeros(0, dtype=str)}
                found = {name: data[name] if name in data or name not in later else later[name] for name in NAMES}
                logs = {name: kind.from_arrays(data) for name, kind in LOGS.items()}
        except ValueError as error:
            raise ValueError(f"{path}: is no history of a run: {error}") from None
        return cls(**{name: tuple(a.tolist()) if name.endswith("_names") else a for name, a in found.items()}, **logs)


LOGS = {"log": PlanLog, "ticks": TickLog, "made": RealTimeLog}
"""Kinds of a history's logs."""
NAMES = tuple(field.name for field in fields(History) if field.name not in LOGS)
"""Names of a history's arrays."""


class HistoryRecorder:
    """Keeps what plant and planner do, for :attr:`history`; hand it to ``run_episode`` or call :meth:`log` yourself.

    Args:
        controller: The controller.
        plant: The plant, at the start of its episode.
        details: More about where the run comes from, plain data, for ``history.log.origin``.
    """

    def __init__(self, controller: Controller, plant: Plant, *, details: Mapping[str, Any] | None = None):
        self._controller, self._plant = controller, plant
        self._turning = turning(plant.scene)
        self._log = PlanLogger(controller, details) if controller.envs == 1 else None
        self._states: list[tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray, list[float]]] = []
        self._plans: list[tuple[np.ndarray, float, list[float], float, float, float]] = []
        self._take_state(np.full((len(plant.pairs), 3), np.nan))

    def log(self, control: np.ndarray) -> None:
        """Keep one control step; call it after ``plant.apply(control)``.

        Args:
            control: The control ``[nu]`` that was applied.

        Raises:
            ValueError: If the controller has not made a plan.
        """
        info = self._controller.info
        if info is None:
            raise ValueError("log comes after controller.step and plant.apply")
        numbers = (info.cost, list(info.terms.values()), info.plan_ms, info.beta, info.eta)
        self._plans.append((np.array(control, dtype=float), *numbers))
        if self._log is not None:
            self._log.log()
        self._take_state(self._plant.forces if self._plant.pairs else np.zeros((0, 3)))

    def close(self) -> None:
        """Nothing is left to do: all is in memory."""

    def _take_state(self, force: np.ndarray) -> None:
        state, error = self._plant.state, self._plant.error
        errors = [] if error is None else [error.position, *(getattr(error, name) for name in self._turning)]
        self._states.append((state.time, state.joint_q, state.joint_qd, self._plant.body_q, np.array(force), errors))

    @property
    def history(self) -> History:
        """The run so far."""
        layout, plans = self._plant.layout, len(self._plans)
        time, joint_q, joint_qd, body_q, force, error = (np.array(c) for c in zip(*self._states, strict=True))
        control, cost, terms, plan_ms, beta, eta = zip(*self._plans, strict=True) if plans else ((),) * 6
        names = tuple(self._controller.costs.labels)
        return History(
            time=time,
            joint_q=joint_q,
            joint_qd=joint_qd,
            body_q=body_q,
            contact_force=force,
            control=np.array(control).reshape(plans, layout.nu),
            cost=np.array(cost, dtype=float),
            cost_terms=np.array(terms, dtype=float).reshape(plans, len(names)),
            plan_ms=np.array(plan_ms, dtype=float),
            beta=np.array(beta, dtype=float),
            eta=np.array(eta, dtype=float),
            goal_error=error,
            term_names=names,
            **names_of(self._plant, self._turning),
            log=self._log.plans if self._log else None,
        )


def names_of(plant: Plant, turns: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """What the numbers of a plant are called, by fields of :class:`History`.

    Args:
        plant: The plant.
        turns: Errors besides that of the position.
    """
    layout = plant.layout
    return {
        "joint_q_names": tuple(_coordinates(layout)),
        "joint_qd_names": tuple(_velocities(layout)),
        "body_names": tuple(layout.body_name),
        "control_names": tuple(layout.control_name),
        "pair_names": tuple(f"{pair.first}-{pair.second}" for pair in plant.pairs),
        "error_names": () if plant.error is None else ("position", *turns),
    }


def turning(scene: Scene) -> list[str]:
    """The turns that a scene's goal or success asks for: ``yaw`` or ``rotation``."""
    wanted = [where for where in (scene.goal, scene.success) if where is not None]
    return [name for name in ("yaw", "rotation") if any(getattr(w, name) is not None for w in wanted)]


def history_file(path: str | Path) -> Path:
    """The path of a file for a history.

    Raises:
        ValueError: If its name does not end in ``.csv`` or ``.npz``.
    """
    path = Path(path)
    if path.suffix not in FILES:
        raise ValueError(f"a history is a {' or '.join(FILES)} file, not '{path}'")
    return path


def _coordinates(layout: Layout) -> Iterator[str]:
    """A name for every joint coordinate."""
    axes = {int(coord): name for coord, name in zip(layout.dof_coord, layout.dof_name, strict=True) if coord >= 0}
    for joint, (first, end) in enumerate(_spans(layout.joint_q_start, layout.nq)):
        moving = layout.body_name[layout.joint_child[joint]]
        names = POSE if end - first == len(POSE) else POSE[3:]  # of a free joint or a ball joint
        yield from (axes.get(i) or f"{moving}/{names[i - first]}" for i in range(first, end))


def _velocities(layout: Layout) -> Iterator[str]:
    """A name for every joint velocity."""
    for joint, (first, end) in enumerate(_spans(layout.joint_qd_start, layout.nv)):
        moving = layout.body_name[layout.joint_child[joint]]
        names = TWIST if end - first == len(TWIST) else TWIST[3:]
        yield from (layout.dof_name[i] or f"{moving}/{names[i - first]}" for i in range(first, end))


def _spans(starts: np.ndarray, total: int) -> list[tuple[int, int]]:
    """First and end of every joint's numbers."""
    return list(zip(map(int, starts), [*map(int, starts[1:]), total], strict=True))
