# SPDX-License-Identifier: Apache-2.0
"""Sliders and buttons of the page; callbacks hand changes to the session and touch nothing else.

Inputs for every key of a section of a scene, made from the section's own schema.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from time import perf_counter
from typing import TYPE_CHECKING, Any, get_args, get_origin

from ...scene.errors import join_key
from ...scene.load import load_scene, shipped_scenes, variants
from ...scene.schema_planner import Plans
from ...scene.types import Section, described
from .closed_loop import norm_values
from .saving import place_of, save, values_of

if TYPE_CHECKING:
    import viser

    from ...scene.schema import Scene
    from .session import Session
    from .snapshot import Snapshot

SETTINGS_KEEP = 1.0
"""Wall time for which an input keeps what was typed, before it shows what the session has [s]."""


class Settings:
    """Inputs of one section of the scene; what they say is the scene's once the session has taken it.

    Numbers, switches and choices have matching inputs, everything else is a text as in a scene file; an
    empty one stands for a key that is left out. Lists of tables (kicks, ancillary controllers) and tables of any names
    (factors, a solver's options) have none.

    Args:
        gui: The page's inputs.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, section: str):
        self._gui, self._session, self._section = gui, session, section
        self._inputs: dict[str, Any] = {}
        self._texts: set[str] = set()
        self._typed: dict[str, float] = {}
        self._values: dict[str, Any] = {}
        self._scene: Scene | None = None
        self._list(getattr(session.scene, section), (section,))

    def _list(self, section: Section, at: tuple[str, ...]) -> None:
        tables = {}
        for name, field in described(type(section)).items():
            value = getattr(section, name)
            if isinstance(value, Section):
                tables[name] = value
            elif not _lists_tables(field.annotation):
                kind = str if type(section)._may_be_absent(name) else field.annotation
                made = self._input(name, kind, value, _plain(field.description))
                self._bind(join_key((*at, name)), made)
        for name, value in tables.items():
            with self._gui.add_folder(name, expand_by_default=False):
                self._list(value, (*at, name))

    def _input(self, name: str, kind: object, value: object, hint: str) -> Any:
        gui, shown = self._gui, _shown(value)
        if isinstance(kind, type) and issubclass(kind, Enum):
            return gui.add_dropdown(name, [choice.value for choice in kind], initial_value=shown, hint=hint)
        if kind is str or not isinstance(value, bool | int | float):
            return gui.add_text(name, _text(value), hint=hint)
        if isinstance(value, bool):
            return gui.add_checkbox(name, shown, hint=hint)
        if isinstance(value, int):
            return gui.add_number(name, shown, step=1, hint=hint)
        return gui.add_number(name, shown, step=_step(value), hint=hint)

    def _bind(self, key: str, made: Any) -> None:
        import viser

        self._inputs[key] = made
        if isinstance(made, viser.GuiTextHandle):
            self._texts.add(key)

        def change(value: Any) -> None:
            self._typed[key] = perf_counter()
            text = value.strip() or "false" if key in self._texts else _toml(value)
            self._session.set_key(key, text)

        on_change(made, change)

    def update(self) -> None:
        """Show the values of the session, except in a field that is being edited."""
        session, now = self._session, perf_counter()
        stale = set(self._typed)
        if session.scene is not self._scene:
            self._scene, stale = session.scene, set(self._inputs)
            self._values = dict(_leaves(getattr(self._scene, self._section), (self._section,)))
        for key in stale - session.waiting.keys():
            if now - self._typed.get(key, -math.inf) < SETTINGS_KEEP:
                continue
            self._typed.pop(key, None)
            made, value = self._inputs[key], self._values.get(key)
            shown = _text(value) if key in self._texts else _shown(value)
            if made.value != shown and type(made.value) is type(shown):
                made.value = shown


def _leaves(section: Section, at: tuple[str, ...]) -> Iterator[tuple[str, object]]:
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, Section):
            yield from _leaves(value, (*at, name))
        else:
            yield join_key((*at, name)), value


def _lists_tables(annotation: object) -> bool:
    """Return whether something is a list of tables, or a table of any names."""
    parts, origin = get_args(annotation), get_origin(annotation)
    own = origin is dict or (origin is tuple and any(isinstance(p, type) and issubclass(p, Section) for p in parts))
    return own or any(_lists_tables(part) for part in parts)


def _shown(value: object) -> Any:
    """Value as a switch, a choice or a number shows it."""
    if isinstance(value, Enum):
        return value.value
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _text(value: object) -> str:
    return "" if value is None else _toml(value.value if isinstance(value, Enum) else value)


def _toml(value: object) -> str:
    import tomlkit

    return tomlkit.item(list(value) if isinstance(value, tuple) else value).as_string()


def _step(value: float) -> float:
    """A hundredth of a number's own size, as a power of ten."""
    return 10.0 ** (math.floor(math.log10(abs(value))) - 1) if value else 0.01


def _plain(text: str | None) -> str:
    return re.sub(r"``|\s*\n\s*", lambda m: " " if "\n" in m[0] else "", text or "")


def on_change(made: Any, change: Callable[[Any], None], *, listed: Sequence[Any] = ()) -> None:
    """Call a function with the new value when a browser changes an input, but not when the page shows one anew.

    A browser may send anything: a value that is not in a dropdown's list, or in ``listed``, is put back.
    """
    listed, held = listed or tuple(getattr(made, "options", ())), made.value

    def changed(event: Any) -> None:
        nonlocal held
        value = made.value  # read once: another message may come
        if listed and value not in listed:
            made.value = held
            return
        held = value
        if event.client is not None:
            change(value)

    made.on_update(changed)


PACES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 4.0)
"""Speeds of the plant's time, as shares of real time."""
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
        with tabs.add_tab("Engine"):
            self._settings.append(Settings(self._gui, session, "engine"))
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
        paces = {pace_words(pace): pace for pace in sorted({*PACES, session.pace})}
        pace = gui.add_dropdown(
            "speed",
            list(paces),
            initial_value=pace_words(session.pace),
            hint="how fast the plant's time passes, at most",
        )
        on_change(pace, lambda words: setattr(session, "pace", paces[words]))
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


def pace_words(pace: float) -> str:
    """A speed of the plant's time as the page has it."""
    return f"{100.0 * pace:g} %"


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
