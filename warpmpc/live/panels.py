# SPDX-License-Identifier: Apache-2.0
"""Sliders and buttons of the page; callbacks hand changes to the session and touch nothing else."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, Any

from ..scene.load import load_scene, shipped_scenes, variants
from ..scene.schema_agent import Plans
from .closed_loop import norm_values
from .saving import place_of, save, values_of
from .settings import Settings, on_change

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import viser

    from .session import Session
    from .snapshot import Snapshot

PACES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 4.0)
"""Speeds of the plant's time, as shares of real time."""
MARKED = (0.001, 0.01, 0.1, 1.0, 4.0)
"""Those that the slider has a mark for."""
KEEP = 0.5
"""Wall time for which a slider stays where the browser put it, until the session has the value, too [s]."""


class Panels:
    """The controls of a session."""

    def __init__(self, server: viser.ViserServer, session: Session):
        self._gui, self._session = server.gui, session
        self._gui.main_panel.dock_right()
        self._status = self._gui.add_markdown("starting")
        self._values: dict[str, viser.GuiSliderHandle] = {}
        self._moved: dict[str, float] = {}
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Run"):
            self._running()
        with tabs.add_tab("Cost"):
            self._costs()
        with tabs.add_tab("Planner"):
            self._settings = [Settings(self._gui, session, "planner")]
        with tabs.add_tab("Plant"):
            self._settings.append(Settings(self._gui, session, "plant"))
        with tabs.add_tab("Scene"):
            self._scenes()

    def _running(self) -> None:
        gui, session = self._gui, self._session
        self._pause = gui.add_button("Pause")
        step, reset = gui.add_button("Step"), gui.add_button("Reset")
        self._record = gui.add_button("Record", hint="for rerun, to a file in the working directory")
        self._seed = gui.add_number("seed", session.seed, min=0, max=2**28, step=1, hint="of the next reset")
        self._pause.on_click(lambda _: session.pause(not session.snapshot.paused))
        self._record.on_click(lambda _: session.record(not session.snapshot.recording))
        step.on_click(lambda _: session.single_step())
        reset.on_click(lambda _: session.reset(int(self._seed.value)))
        paces = sorted({*PACES, session.pace})
        pace = gui.add_slider(
            "speed",
            0,
            len(paces) - 1,
            1,
            paces.index(session.pace),
            marks=tuple((i, f"{100.0 * p:g} %") for i, p in enumerate(paces) if p in (*MARKED, session.pace)),
            hint="how fast the plant's time passes, at most",
        )
        on_change(pace, lambda i: setattr(session, "pace", paces[int(i)]), listed=range(len(paces)))
        self._planning = gui.add_checkbox("plan", True, hint="off: the last plan is followed to its end")
        on_change(self._planning, session.plan_or_not)
        self._controlling = gui.add_checkbox(
            "control", True, hint="off: the robot is sent the safe command of its drives, plans are made all the same"
        )
        on_change(self._controlling, session.control_or_not)
        self._lock_step = gui.add_checkbox(
            "lock step", session.lock_step, hint="every control waits for its own plan; off: the newest one is followed"
        )
        on_change(self._lock_step, session.step_or_follow)
        plans = gui.add_dropdown(
            "plans",
            [kind.value for kind in Plans],
            initial_value=session.scene.agent.plans.value,
            hint="for every control, without lock step: one, or as many as fit: a slower clock gives more",
        )
        on_change(plans, lambda value: session.set_key("agent.plans", f'"{value}"'))
        gui.add_markdown("Drag a body to pull at it, with *shift* to turn it; drag the arrows to move what is wanted.")

    def _costs(self) -> None:
        task = self._session.controller.task
        for name in task.weight_name:
            self._value(name)
        if task.scalar_name:
            with self._gui.add_folder("scalars"):
                for name in task.scalar_name:
                    self._value(name)
        if norms := norm_values(self._session.scene):
            with self._gui.add_folder("norms"):
                for key, value in norms.items():
                    self._norm(key, value)

    def _value(self, name: str) -> None:
        """A slider from zero to four times the value."""
        value = float(f"{self._session.controller.task[name]:.6g}")  # of a float32
        low, high = (0.0, 4.0 * value) if value > 0.0 else (4.0 * value, 1.0)
        self._slider(name, name, (low, high, value), lambda value: self._session.set_value(name, value))

    def _norm(self, key: str, value: float) -> None:
        """A slider up to four times a parameter of a norm, from above zero or, where it may not be below one, from it.

        Another controller takes it: the plan is followed meanwhile.
        """
        least = 1.0 if value >= 1.0 else 0.01 * value
        label = key.removeprefix("cost.").replace(".norm.", " ")
        self._slider(key, label, (least, 4.0 * value, value), lambda value: self._session.set_key(key, f"{value:.6g}"))

    def _slider(self, name: str, label: str, numbers: Sequence[float], change: Callable[[float], None]) -> None:
        """A slider of a value in the session's snapshot.

        Args:
            name: Name of the value there.
            label: Its name on the page.
            numbers: Least and largest value, and the present one.
            change: Called with another value.
        """
        low, high, value = numbers
        step = float(f"{(high - low) / 400.0:.6g}")
        slider = self._values[name] = self._gui.add_slider(label, low, high, step, value)

        def move(value: float) -> None:
            self._moved[name] = perf_counter()
            change(float(value))

        on_change(slider, move)

    def _scenes(self) -> None:
        gui, session = self._gui, self._session
        names = [f"{name}:{v}" if v else name for name in shipped_scenes() for v in (None, *variants(name))]
        scene = gui.add_dropdown("scene", list(dict.fromkeys([session.source, *names])), initial_value=session.source)
        on_change(scene, session.switch)
        button = gui.add_button(
            "Save", disabled=session.scene.path is None, hint="what was changed, and values of --set"
        )
        self._said, self._file = gui.add_markdown(""), None
        button.on_click(lambda _: self._save())

    def _save(self) -> None:
        session = self._session
        texts = [*session.overrides, *(f"{key}={value}" for key, value in session.keys.items())]
        try:
            written = load_scene(session.source)
            texts += values_of(written.cost_labels, dict(session.tuned))
            self._file = self._file or place_of(written.path)
            save(written.path, written.variant, texts, to=self._file)
            self._said.content = f"saved to `{self._file}`: {', '.join(f'`{text}`' for text in texts) or 'no changes'}"
        except Exception as error:  # a click must not end in the terminal alone
            self._said.content = f"**not saved:** {error}"

    def update(self, snapshot: Snapshot) -> None:
        """Show how it goes."""
        text = f"**{snapshot.status}** · t = {snapshot.time:.2f} s · step {snapshot.steps}"
        if snapshot.foreseen is not None:
            text += f" · foresight {snapshot.foreseen.error:.0%} off"
        text += f"\n\n{_plan_words(snapshot)}"
        if snapshot.recording:
            text += f"\n\nrecording to `{snapshot.recording}`"
        if snapshot.message:
            text += f"\n\n**refused:** {snapshot.message}"
        _show(self._status, "content", text)
        _show(self._pause, "label", "Resume" if snapshot.paused else "Pause")
        _show(self._record, "label", "Stop recording" if snapshot.recording else "Record")
        _show(self._planning, "value", snapshot.planning)
        _show(self._controlling, "value", snapshot.controlling)
        _show(self._lock_step, "value", snapshot.lock_step)
        now = perf_counter()
        for name, slider in self._values.items():
            value = float(f"{snapshot.values[name]:.6g}")
            still = now - self._moved.get(name, 0.0) > KEEP and name not in self._session.waiting
            if still and slider.value != value:
                slider.min, slider.max = min(slider.min, value), max(slider.max, value)
                slider.value = value
        for settings in self._settings:
            settings.update()


def _plan_words(snapshot: Snapshot) -> str:
    """Rate, times and age of plans."""
    rate = snapshot.rate
    parts = [
        (rate.p50, f"plan {rate.p50:.1f} ms, p99 {rate.p99:.1f} ms"),
        (snapshot.age, f" · age {1e3 * snapshot.age:.0f} ms"),
        (rate.rate, f"  \n{rate.rate:.1f} plans/s"),
        (snapshot.plans, f" · {snapshot.plans:.1f} plans a control"),
    ]
    return "".join(text for number, text in parts if number == number)


def _show(handle: Any, name: str, value: object) -> None:
    if getattr(handle, name) != value:
        setattr(handle, name, value)
