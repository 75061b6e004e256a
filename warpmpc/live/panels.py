# SPDX-License-Identifier: Apache-2.0
"""Sliders and buttons of the page; callbacks hand changes to the session and touch nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..scene.errors import SceneError
from ..scene.schema_planner import Method
from .saving import save

if TYPE_CHECKING:
    import viser

    from .session import Session, Snapshot


class Panels:
    """The controls of a session.

    Args:
        server: The page's server.
        session: The session.
    """

    def __init__(self, server: viser.ViserServer, session: Session):
        self._gui, self._session = server.gui, session
        self._status = self._gui.add_markdown("starting")
        self._running()
        with self._gui.add_folder("Weights"):
            for name in session.controller.task.weight_name:
                self._value(name)
        if session.controller.task.scalar_name:
            with self._gui.add_folder("Scalars"):
                for name in session.controller.task.scalar_name:
                    self._value(name)
        with self._gui.add_folder("Planner"):
            self._planner()
        with self._gui.add_folder("Save"):
            self._saving()

    def _running(self) -> None:
        gui, session = self._gui, self._session
        self._pause = gui.add_button("Pause")
        step, reset = gui.add_button("Step"), gui.add_button("Reset")
        seed = gui.add_number("Seed", session.seed, min=0, max=2**28, step=1)
        pace = gui.add_slider("Pace", 0.05, 4.0, 0.05, session.pace, hint="simulated seconds per second at most")
        planning = gui.add_checkbox("Plan", True, hint="off: the robot is sent the control zero")
        self._pause.on_click(lambda _: session.pause(not session.snapshot.paused))
        step.on_click(lambda _: session.single_step())
        reset.on_click(lambda _: session.reset(int(seed.value)))
        pace.on_update(lambda _: setattr(session, "pace", float(pace.value)))
        planning.on_update(lambda _: session.plan_or_not(planning.value))

    def _value(self, name: str) -> None:
        """A slider from zero to four times the value."""
        session = self._session
        value = float(f"{session.controller.task[name]:.6g}")  # of a float32
        low, high = (0.0, 4.0 * value) if value > 0.0 else (4.0 * value, 1.0)
        step = float(f"{(high - low) / 400.0:.6g}")
        slider = self._gui.add_slider(name, low, high, step, value)
        slider.on_update(lambda _: session.set_value(name, float(slider.value)))

    def _planner(self) -> None:
        gui, planner = self._gui, self._session.scene.planner
        method = gui.add_dropdown("Method", tuple(m.value for m in Method), initial_value=planner.method.value)
        self._rebuilds(method, "planner.method", lambda: f'"{method.value}"')
        samples = gui.add_number("Samples", int(planner.samples), min=2, step=1)
        self._rebuilds(samples, "planner.samples", lambda: str(int(samples.value)))
        horizon = gui.add_number("Horizon", planner.horizon, min=1, step=1, hint="steps of a rollout")
        self._rebuilds(horizon, "planner.horizon", lambda: str(int(horizon.value)))
        sigma = planner.noise.sigma
        ranged = hasattr(sigma, "range")
        numbers = sigma.range if ranged else sigma
        key = "planner.noise.sigma" + (".range" if ranged else "")
        if numbers is not None:
            factor = gui.add_slider("Sigma ×", 0.1, 4.0, 0.1, 1.0, hint="factor of the noise's standard deviation")
            many = isinstance(numbers, list | tuple)
            self._rebuilds(
                factor,
                key,
                lambda: str([n * factor.value for n in numbers]) if many else str(numbers * factor.value),
            )
        start = float(planner.temperature.initial)
        heat = gui.add_slider("Temperature", 0.02 * start, 5.0 * start, 0.02 * start, start, hint="where it starts")
        self._rebuilds(heat, "planner.temperature.initial", lambda: str(float(heat.value)))

    def _rebuilds(self, handle: object, key: str, text: Callable[[], str]) -> None:
        handle.on_update(lambda _: self._session.set_planner(key, text()))

    def _saving(self) -> None:
        session, path = self._session, self._session.scene.path
        button = self._gui.add_button("Save to the scene's file", disabled=path is None)
        said = self._gui.add_markdown("")

        def click(_: object) -> None:
            try:
                save(path, session.scene.cost_labels, dict(session.tuned), dict(session.planner_keys))
                said.content = f"saved to {path.name}"
            except (SceneError, OSError, KeyError) as error:
                said.content = f"**not saved:** {error}"

        button.on_click(click)

    def update(self, snapshot: Snapshot) -> None:
        """Show how it goes."""
        state = snapshot.reason or ("paused" if snapshot.paused else "running")
        text = f"**{state}** · t = {snapshot.time:.2f} s · step {snapshot.steps} · plan {snapshot.plan_ms:.0f} ms"
        if snapshot.message:
            text += f"\n\n**refused:** {snapshot.message}"
        if text != self._status.content:
            self._status.content = text
        label = "Resume" if snapshot.paused else "Pause"
        if self._pause.label != label:
            self._pause.label = label
