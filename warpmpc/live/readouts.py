# SPDX-License-Identifier: Apache-2.0
"""Readouts of the page: settings of model and engines, joint values and sensor readings as bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from time import perf_counter
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..engine.registry import ENGINES, physics_steps
from ..scene.schema import EngineName
from ..thread_pool import thread_count

if TYPE_CHECKING:
    import viser

    from ..controller.controller import Controller
    from ..model.layout import Layout
    from ..plant.simulated import SimulatedPlant
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
