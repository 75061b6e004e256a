# SPDX-License-Identifier: Apache-2.0
"""Readouts of the page: settings of model and engines, joint values and sensor readings as bars.

Curves of the page: cost of each term and controls, past and predicted, foresight, what β and η are, plan times.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from time import perf_counter
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...engine.registry import ENGINES, physics_steps
from ...physics.runtime.thread_pool import thread_count
from ...scene.model.state import PROPOSERS
from ...scene.schema import EngineName
from ..doctor.foresight import AHEAD

if TYPE_CHECKING:
    import viser

    from ...loop.plant.simulated import SimulatedPlant
    from ...planner.controller.controller import Controller
    from ...scene.model.layout import Layout
    from .session import Session
    from .snapshot import Snapshot

PERIOD = 0.2
"""Wall time between two pictures of the bars [s]."""
UNLIMITED = 1e3
"""Width from which a range counts as no limit [m or rad]."""
_STYLE = (
    "<style>.readout{font-size:12px;line-height:1.35;border-collapse:collapse;margin:0.4em;width:96%}"
    ".readout td,.readout th{padding:0 0.3em;text-align:right;font-variant-numeric:tabular-nums}"
    ".readout td:first-child,.readout th:first-child{text-align:left;word-break:break-word}"
    ".readout caption{text-align:left;font-weight:bold;padding:0 0.3em}.readout meter{width:64px;display:block}</style>"
)


class Readouts:
    """The readouts of a session.

    Args:
        panel: Where they stand.
    """

    def __init__(self, panel: viser.GuiPanelHandle, server: viser.ViserServer, session: Session):
        self._session, self._layout, self._drawn = session, session.plant.layout, 0.0
        self._largest: dict[str, np.ndarray] = {}
        self._built: tuple[object, object] | None = None
        with panel.add_tab("State"):
            self._state = server.gui.add_html("")
        with panel.add_tab("Model"):
            self._model = server.gui.add_html("")

    def update(self, snapshot: Snapshot) -> None:
        """Show a snapshot's values."""
        session = self._session
        built = session.controller, session.plant
        if built != self._built:
            self._built, self._layout, self._largest = built, built[1].layout, {}
            self._model.content = _STYLE + table(model_facts(*built))
        if perf_counter() - self._drawn < PERIOD or len(snapshot.joint_q) != self._layout.nq:
            return
        self._drawn = perf_counter()
        content = _STYLE
        for title, readings in (
            ("joints", joints(self._layout, snapshot)),
            ("sensors", sensors(self._layout, snapshot)),
        ):
            sizes = np.abs([reading.value for reading in readings])
            largest = self._largest[title] = np.maximum(self._largest.get(title, 0.0), sizes)
            content += bars(title, readings, largest) if readings else ""
        if content != self._state.content:
            self._state.content = content


@dataclass(frozen=True)
class Reading:
    """A number that is shown as a bar."""

    name: str
    value: float
    limits: tuple[float, float] | None = None


def joints(layout: Layout, snapshot: Snapshot) -> list[Reading]:
    """All hinges and slides [rad or m], with their ranges."""
    found = []
    for dof, name in enumerate(layout.dof_name):
        limits = float(layout.dof_lower[dof]), float(layout.dof_upper[dof])
        if name:
            value = float(snapshot.joint_q[layout.dof_coord[dof]])
            found.append(Reading(name, value, limits if limits[1] - limits[0] < UNLIMITED else None))
    return found


def sensors(layout: Layout, snapshot: Snapshot) -> list[Reading]:
    """All numbers of the sensors of MJCF files."""
    found = []
    for name, start, count in zip(layout.sensor_name, layout.sensor_start, layout.sensor_dim, strict=True):
        numbers = enumerate(snapshot.sensor[start : start + count].tolist())
        found += [Reading(f"{name}[{i}]" if count > 1 else name, number) for i, number in numbers]
    return found


def bars(title: str, readings: Sequence[Reading], largest: Sequence[float]) -> str:
    """A table of bars; those without limits reach to the largest size so far.

    Args:
        title: Its title.
        readings: Numbers ``[n]``; a robot that they all belong to is not named.
        largest: Largest size of each so far ``[n]``.
    """
    rows, alone = [], len({reading.name.partition("/")[0] for reading in readings}) == 1
    for reading, most in zip(readings, largest, strict=True):
        low, high = reading.limits or (-most, most)
        ends = (f"{low:.3g}", f"{high:.3g}") if reading.limits else ("", "")
        bar = f'<meter min="{low:.6g}" max="{high:.6g}" value="{reading.value:.6g}"></meter>'
        name = escape(reading.name.partition("/")[2] if alone else reading.name)
        rows.append("".join(f"<td>{cell}</td>" for cell in (name, ends[0], bar, ends[1], f"{reading.value:.3f}")))
    return f'<table class="readout"><caption>{title}</caption><tr>{"</tr><tr>".join(rows)}</tr></table>'


def table(facts: Sequence[Sequence[str]]) -> str:
    """A table whose first row is its heading."""
    head, *rows = facts
    lines = ["".join(f"<th>{escape(cell)}</th>" for cell in head)]
    lines += ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    return f'<table class="readout"><tr>{"</tr><tr>".join(lines)}</tr></table>'


def model_facts(controller: Controller, plant: SimulatedPlant) -> list[tuple[str, ...]]:
    """Settings of the rollouts' physics and of the plant's, and sizes of the model; the first row is a heading."""
    scene, layout, model = controller.scene, controller.layout, plant.model
    rows = [("", "rollouts", "plant")]
    rows += [("engine", controller.engine.name, EngineName.MUJOCO.value), ("device", controller.device, "cpu")]
    rows += [("threads", str(thread_count(scene.engine.threads)) if controller.device == "cpu" else "", "1")]
    steps, control_dt = controller.plan_step.grid.dt, scene.timing.control_dt
    physics = physics_steps(controller.engine.name, scene, controller.compiled, controller.plan_step.grid)
    rows += [("control", "", _ms(control_dt)), ("lookahead", f"{steps.sum():.3g} s in {len(steps)} steps", "")]
    own = {"timestep": _ms(physics.length[0])} if ENGINES[controller.engine.name].physics else {}
    if (stepped := getattr(controller.engine, "mj_model", None)) is not None:
        own = _option_words(stepped.opt)
    elif controller.engine.name == EngineName.NEWTON:
        own["solver"] = scene.engine.solver.value
    rows += [(name, own.get(name, ""), value) for name, value in _option_words(model.opt).items()]
    shape = controller.shape
    rows += [("worlds", str(shape.worlds), "1")]
    sizes = {"nq": layout.nq, "nv": layout.nv, "nu": layout.nu, "bodies": layout.nb, "sensors": layout.ns}
    rows += [(name, str(size), "") for name, size in sizes.items()]
    return [*rows, ("mass", f"{layout.body_mass.sum():.4g} kg", f"{model.body_mass.sum():.4g} kg")]


def _option_words(option: mujoco.MjOption) -> dict[str, str]:
    """MuJoCo's options in words, by name."""
    return {
        "timestep": _ms(option.timestep),
        "integrator": mujoco.mjtIntegrator(int(option.integrator)).name.removeprefix("mjINT_").lower(),
        "solver": mujoco.mjtSolver(int(option.solver)).name.removeprefix("mjSOL_").lower(),
        "iterations": str(option.iterations),
        "tolerance": f"{option.tolerance:g}",
        "friction cone": mujoco.mjtCone(int(option.cone)).name.removeprefix("mjCONE_").lower(),
    }


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"


PLOTS_PERIOD = 0.3
"""Wall time between two pictures of the curves [s]; browsers without a GPU are slow at them."""
KEPT = 300
"""Points of a curve."""
CURVES = 8
"""Curves of one plot, that can still be told apart."""
COLORS = ("#e6194b", "#3cb44b", "#4363d8", "#f58231", "#911eb4", "#17a2b8", "#b8860b", "#f032e6")
TICKS, PADDING, NO_MARKS = 72, (10, 24, 0, 0), {"show": False}
"""Room for the numbers of a vertical axis, seven digits, and around a plot [pixels]: the highest number is whole."""
RECENT = 25.0
"""Plans over which the shares of their proposers are means."""
AHEAD_COLOR = "rgba(0, 0, 0, 0.07)"
FORESIGHT = f"cost of the last {AHEAD:g} s: foreseen, came"
WIDTH = 330.0
"""Width of the panel [pixels]."""


class Plots:
    """The curves of a session."""

    def __init__(self, server: viser.ViserServer, session: Session):
        self._budget, layout = 1e3 * session.scene.timing.control_dt, session.plant.layout
        self._labels, controls = session.controller.costs.labels, layout.control_name
        self._rows: deque[list[float]] = deque(maxlen=KEPT)
        self._episode, self._steps, self._drawn = -1, -1, 0.0
        terms, nu = len(self._labels), len(controls)
        self._widths = (terms, nu, 1, 1, 2, 2, len(PROPOSERS))
        self._shares = np.zeros(len(PROPOSERS))
        self.panel = server.gui.add_panel()
        """The panel, for further tabs."""
        self.panel.dock_left()
        self.panel.set_width(WIDTH)
        with self.panel.add_tab("Curves"):
            self._plots = [
                *self._split(server, "cost of a step", self._labels, 0, ahead=True),
                *self._split(server, "control", controls, terms, ahead=True),
                *self._split(server, "effective samples η", ("η",), terms + nu),
                *self._split(server, "temperature β", ("β",), terms + nu + 1),
                *self._split(server, "plan time [ms]", ("plan", "budget"), terms + nu + 2),
            ]
            if session.foresight.known:
                self._plots += self._split(server, FORESIGHT, ("foreseen", "came"), terms + nu + 4)
            if session.controller.plan_step.refiner:
                self._plots += self._split(server, "share of the plans from", PROPOSERS, terms + nu + 6)

    def _split(
        self, server: viser.ViserServer, title: str, names: Sequence[str], first: int, *, ahead: bool = False
    ) -> list[tuple[object, slice, bool]]:
        """Plots of at most :data:`CURVES` curves each, about as many in all; several have numbers in their titles.

        Returns:
            For each its handle, its columns and whether it goes on into the future.
        """
        from viser import uplot

        made = []
        for columns in np.array_split(np.arange(len(names)), max(1, -(-len(names) // CURVES))):
            begin, end = (int(columns[0]), int(columns[-1]) + 1) if len(columns) else (0, 0)
            part, which = names[begin:end], f", {begin + 1} to {end} of {len(names)}" * (end - begin < len(names))
            series = [uplot.Series(label="t [s]")]
            if ahead:
                series.append(uplot.Series(label="ahead", scale="ahead", fill=AHEAD_COLOR, width=0))
            series += [
                uplot.Series(label=name, stroke=color, width=1.5) for name, color in zip(part, COLORS, strict=False)
            ]
            handle = server.gui.add_uplot(
                tuple(np.zeros(1) for _ in series),
                tuple(series),
                title=title + which,
                scales={"x": uplot.Scale(time=False), "ahead": uplot.Scale(range=(0.0, 1.0))},
                axes=(uplot.Axis(ticks=NO_MARKS), uplot.Axis(ticks=NO_MARKS, size=TICKS)),
                padding=PADDING,
                legend=uplot.Legend(show=len(names) > 1),
                aspect=1.8,
            )
            made.append((handle, slice(first + begin, first + end), ahead))
        return made

    def update(self, snapshot: Snapshot) -> None:
        """Add a snapshot's numbers."""
        if snapshot.episode != self._episode:
            self._rows.clear()
            self._episode = snapshot.episode
        elif snapshot.steps == self._steps:
            return
        self._steps, ahead = snapshot.steps, snapshot.forecast
        if ahead is not None:
            seen = snapshot.foreseen
            numbers = [snapshot.eta, snapshot.beta, snapshot.plan_ms, self._budget]
            numbers += [np.nan, np.nan] if seen is None else [seen.cost, seen.came]
            self._shares += (np.array([name == snapshot.proposer for name in PROPOSERS]) - self._shares) / RECENT
            self._rows.append([snapshot.time, *ahead.cost[:, 0], *snapshot.control, *numbers, *self._shares])
        if perf_counter() - self._drawn < PLOTS_PERIOD or not self._rows:
            return
        self._drawn = perf_counter()
        past = np.array(self._rows)
        future = past[:0]
        if ahead is not None:
            future, known = np.zeros((len(ahead.times), past.shape[1])), sum(self._widths[:2])
            future[:, 0] = ahead.times
            future[:, 1 : 1 + known] = np.hstack([ahead.cost.T, ahead.control])
        for plot, columns, goes_on in self._plots:
            plot.data = _curves(past, future, columns) if goes_on else _curves(past, None, columns)


def _curves(past: np.ndarray, future: np.ndarray | None, columns: slice) -> tuple[np.ndarray, ...]:
    """Times, whether they are ahead if there is a future, and curves; where one is not finite it keeps its value."""
    rows = past if future is None else np.vstack([past, future])
    times, curves = rows[:, 0], [_kept(curve) for curve in rows[:, 1:][:, columns].T]
    order = np.argsort(times, kind="stable")
    marks = [] if future is None else [np.repeat([0.0, 1.0], [len(past), len(future)])]
    return tuple(np.ascontiguousarray(row[order]) for row in (times, *marks, *curves))


def _kept(curve: np.ndarray) -> np.ndarray:
    """A curve ``[n]`` whose values that are not finite are the finite one before; browsers do not draw others."""
    finite = np.flatnonzero(np.isfinite(curve))
    if not len(finite):
        return np.zeros_like(curve)
    return curve[finite[np.maximum(np.searchsorted(finite, np.arange(len(curve)), side="right") - 1, 0)]]
