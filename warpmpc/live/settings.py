# SPDX-License-Identifier: Apache-2.0
"""Inputs for every key of a section of a scene, made from the section's own schema."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from time import perf_counter
from typing import TYPE_CHECKING, Any, get_args, get_origin

from ..scene.errors import join_key
from ..scene.types import Section

if TYPE_CHECKING:
    import viser

    from ..scene.schema import Scene
    from .session import Session

KEEP = 1.0
"""Wall time for which an input keeps what was typed, before it shows what the session has [s]."""


class Settings:
    """Inputs of one section of the scene; what they say is the scene's once the session has taken it.

    Numbers, switches and choices have inputs of their own kind, everything else is a text as in a scene file; an
    empty one stands for a key that is left out. Lists of tables (kicks, ancillary controllers) and tables by name
    (factors) have none.

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
        for name, field in type(section).model_fields.items():
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
        """Show what the session has, where nobody is typing."""
        session, now = self._session, perf_counter()
        stale = set(self._typed)
        if session.scene is not self._scene:
            self._scene, stale = session.scene, set(self._inputs)
            self._values = dict(_leaves(getattr(self._scene, self._section), (self._section,)))
        for key in stale - session.waiting.keys():
            if now - self._typed.get(key, -math.inf) < KEEP:
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
    """Return whether something is a list of tables, or has them by name."""
    parts = get_args(annotation)
    own = get_origin(annotation) in (tuple, dict) and any(isinstance(p, type) and issubclass(p, Section) for p in parts)
    return own or any(_lists_tables(part) for part in parts)


def _shown(value: object) -> Any:
    """Value as a switch, a choice or a number shows it."""
    if isinstance(value, Enum):
        return value.value
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _text(value: object) -> str:
    """Value as a text shows it."""
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
