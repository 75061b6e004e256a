# SPDX-License-Identifier: Apache-2.0
"""Recorder of a run: plant and planner, kept as a run log."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..log.run_log import RunLog
from ..log.writer import POSE, RunLogWriter, row_type
from ..realtime.plan_logger import CLOSED_LOOP, plan_columns, provenance, sizes

if TYPE_CHECKING:
    from ...planner.controller.controller import Controller
    from ...scene.model.layout import Layout
    from ...scene.model.state import State
    from ...scene.schema import Scene
    from ..plant.plant import Plant
    from ..realtime.agent import Fault
    from ..realtime.messages import TimedPlan

TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")


class RunRecorder:
    """Keeps what plant and planner do as a :class:`~warpmpc.RunLog`.

    In closed loop it goes to ``run_episode``, or :meth:`log` is called after ``plant.apply``. In real time, without a
    controller, it goes to ``RobotLoop``, which calls :meth:`tick`: that costs copies of some numbers, and a thread
    writes.

    Args:
        plant: The plant, at the start of its episode.
        controller: The controller, of one environment; None in real time.
        path: A file, ``.runlog``, into which every row goes as it comes; in memory if None.
        details: More about where the run comes from, plain data, for the log's ``origin``.

    Raises:
        ValueError: If the controller has several environments.
    """

    def __init__(
        self,
        plant: Plant,
        controller: Controller | None = None,
        *,
        path: str | Path | None = None,
        details: Mapping[str, Any] | None = None,
    ):
        if controller is not None and controller.envs != 1:
            raise ValueError(f"a run log is of one environment, not of {controller.envs}")
        self._plant, self._controller, layout = plant, controller, plant.layout
        self._turning = turning(plant.scene)
        names = {**names_of(plant), "terms": list(controller.costs.labels) if controller else []}
        found = {name: getattr(layout, name) for name in ("nq", "nv", "na", "nm", "nb", "nu")}
        found |= {"pairs": len(plant.pairs), "errors": len(names["errors"])}
        tables, origin = {"states": row_type("states", found)}, None
        if controller is None:
            tables |= {"controls": row_type("controls", found), "faults": row_type("faults", found)}
            self._shapes = {
                name: tables["controls"][name].shape for name in ("seen_q", "seen_qd", "seen_act", "seen_mocap")
            }
        else:
            tables["controls"] = row_type("controls", found, ("control", "plan", "plan_ms"))
            tables["plans"] = row_type("plans", sizes(controller), CLOSED_LOOP)
            tables["clouds"] = row_type("clouds", {})
            origin = {**provenance(controller), "from_start": controller.info is None, **(details or {})}
        self._clouds: dict[str, np.ndarray] = {}
        self._count = 0
        # a driver's robot is in the state of a tick during it, a plant in that after it: its log ends with the state in
        # which the last command was sent, and without that command
        self._moves_when_observed = getattr(plant, "moves_when_observed", False)
        self._ticked = False
        self._last_fault: tuple = ()  # of the newest fault
        path = None if path is None else Path(path)
        self._writer = RunLogWriter(path, tables, names=names, origin=origin, background=controller is None)
        self._take_state(np.nan)

    def log(self, control: np.ndarray) -> None:
        """Keep one control step; call it after ``plant.apply(control)``.

        Args:
            control: The control ``[nu]`` that was applied.

        Raises:
            ValueError: If the controller has not made a plan.
        """
        controller = self._controller
        if controller.info is None:
            raise ValueError("log comes after controller.step and plant.apply")
        self._take_clouds()
        columns, plan = plan_columns(controller, controller.observed), controller.newest_plan
        columns |= {"command": controller.command, "knot_time": plan.times, "knots": plan.knots}
        self._writer.add("plans", number=self._count, **columns)
        self._writer.add("controls", control=control, plan=self._count, plan_ms=controller.info.plan_ms)
        self._count += 1
        self._take_state(self._plant.forces)

    def tick(
        self,
        control: np.ndarray | None,
        timed: TimedPlan | None,
        *,
        seen: State,
        now: float,
        following: bool,
        late: float,
        faults: Sequence[Fault],
    ) -> None:
        """Keep one tick in real time; the robot has got its command.

        Args:
            control: The control ``[nu]`` that was sent, None where none was.
            timed: The newest plan, None before the first.
            seen: What was observed.
            now: The robot's clock [s].
            following: Whether the control came from the plan.
            late: How late the tick was, in wall time [s].
            faults: What went wrong so far, the newest last.
        """
        if self._moves_when_observed and self._ticked:
            self._take_state(self._plant.forces)
        self._ticked = True
        layout, nothing = self._plant.layout, np.nan
        act, mocap = (a if b is None else b for a, b in ((layout.act, seen.act), (layout.mocap, seen.mocap)))
        parts = zip(self._shapes.items(), (seen.joint_q, seen.joint_qd, act, mocap), strict=True)
        self._writer.add(
            "controls",
            control=nothing if control is None else control,
            plan=-1 if timed is None else timed.number,
            plan_ms=nothing if timed is None else timed.plan_ms,
            age=nothing if timed is None else self._time - timed.observed,
            following=following,
            late_ms=1e3 * late,
            clock=now,
            seen_time=seen.time,
            **{
                n: np.reshape(part, shape) if np.size(part) == np.prod(shape) else nothing for (n, shape), part in parts
            },
        )
        if faults:
            index, fault = len(faults) - 1, faults[-1]
            row = (index, fault.kind, fault.why, fault.start, nothing if fault.end is None else fault.end, fault.count)
            if row != self._last_fault:
                self._last_fault = row
                self._writer.add(
                    "faults", **dict(zip(("index", "kind", "why", "start", "end", "count"), row, strict=True))
                )
        if not self._moves_when_observed:
            self._take_state(self._plant.forces)

    @property
    def run_log(self) -> RunLog:
        """The run so far, in real time without its plans, which the planner notes."""
        return RunLog.parse(self._writer.content())

    def close(self) -> None:
        """Write what is left and close the file."""
        self._writer.close()

    def _take_state(self, force: np.ndarray | float) -> None:
        plant = self._plant
        state, error = plant.state, plant.error
        self._time = state.time
        errors = [] if error is None else [error.position, *(getattr(error, name) for name in self._turning)]
        self._writer.add(
            "states",
            time=state.time,
            joint_q=state.joint_q,
            joint_qd=state.joint_qd,
            body_q=plant.body_q,
            contact_force=force if plant.pairs else np.zeros((0, 3)),
            goal_error=errors,
        )

    def _take_clouds(self) -> None:
        """Keep the clouds that the newest plan was the first to see."""
        for index, cloud in enumerate(self._controller.scene.cloud):
            points = self._controller.task.points(cloud.name)
            if points is self._clouds.get(cloud.name):  # arrays are replaced, not changed in place
                continue
            self._clouds[cloud.name] = points
            rows = np.zeros(1 + len(points), row_type("clouds", {}))
            rows["cloud"], rows["plan"], rows["begins"][0] = index, self._count, True
            rows["point"][1:] = points
            self._writer.add_rows("clouds", rows)


def names_of(plant: Plant) -> dict[str, list[str]]:
    """Names of the numbers of a plant, as :class:`~warpmpc.RunLog` has them."""
    layout = plant.layout
    axes = {int(coord): name for coord, name in zip(layout.dof_coord, layout.dof_name, strict=True) if coord >= 0}
    speeds = dict(enumerate(layout.dof_name))
    return {
        "joint_q": list(_joint_numbers(layout, layout.joint_q_start, layout.nq, axes, POSE)),
        "joint_qd": list(_joint_numbers(layout, layout.joint_qd_start, layout.nv, speeds, TWIST)),
        "bodies": list(layout.body_name),
        "controls": list(layout.control_name),
        "pairs": [f"{pair.first}-{pair.second}" for pair in plant.pairs],
        "errors": [] if plant.error is None else ["position", *turning(plant.scene)],
        "clouds": [cloud.name for cloud in plant.scene.cloud],
    }


def turning(scene: Scene) -> list[str]:
    """The turns that a scene's goal or success asks for: ``yaw`` or ``rotation``."""
    wanted = [where for where in (scene.goal, scene.success) if where is not None]
    return [name for name in ("yaw", "rotation") if any(getattr(w, name) is not None for w in wanted)]


def _joint_numbers(
    layout: Layout, starts: np.ndarray, total: int, axes: Mapping[int, str], parts: Sequence[str]
) -> Iterator[str]:
    """A name for every joint coordinate or velocity: of its axis, or of its part where a joint has no axes."""
    for joint, (first, end) in enumerate(itertools.pairwise([*map(int, starts), total])):
        moving = layout.body_name[layout.joint_child[joint]]
        names = parts if end - first == len(parts) else parts[3:]  # of a free joint or a ball joint
        yield from (axes.get(i) or f"{moving}/{names[i - first]}" for i in range(first, end))
