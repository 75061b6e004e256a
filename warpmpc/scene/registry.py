# SPDX-License-Identifier: Apache-2.0
"""Engines, strategies, cost terms and robots by name: shipped, or registered by programs and installed packages.

A package brings one as an entry point of the registry's group, in its ``pyproject.toml``::

    [project.entry-points."warpmpc.strategies"]
    mine = "my_package.planning:make"
"""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from contextlib import contextmanager
from enum import StrEnum
from functools import cached_property
from typing import Any, Self, TypeVar

T = TypeVar("T")
logger = logging.getLogger("warpmpc")


class Registry(MutableMapping[str, T]):
    """Things of one kind by name; what an entry point names is loaded when it is asked for.

    Args:
        kind: What they are called in messages.
        group: Group of the entry points.
    """

    def __init__(self, kind: str, group: str):
        self._kind, self._group = kind, group
        self._of_file: dict[str, dict[str, T | None]] = {}
        self._loaded: dict[str, T] = {}
        self.load_registered: Callable[[], object] = lambda: None
        """Imports what registers those of warpmpc; set by ``warpmpc/__init__.py`` where they are in a higher room."""
        self.load_shipped: Callable[[], Mapping[str, T]] = dict
        """Returns what is shipped, when the registry is first read; set by ``warpmpc/__init__.py`` where they are in a
        higher room."""

    @cached_property
    def shipped(self) -> Mapping[str, T]:
        """Those that come with warpmpc through :attr:`load_shipped`."""
        return self.load_shipped()

    @cached_property
    def _known(self) -> dict[str, T]:
        return dict(self.shipped)

    @cached_property
    def _points(self) -> dict[str, importlib.metadata.EntryPoint]:
        points: dict[str, importlib.metadata.EntryPoint] = {}
        for point in importlib.metadata.entry_points(group=self._group):
            held = points.setdefault(point.name, point)
            if (held.value, self._package(held)) == (point.value, self._package(point)):
                continue
            wins, loses = (point, held) if self._package(point) == "warpmpc" else (held, point)
            points[point.name] = wins
            logger.warning(
                "the %s '%s' of %s is left out: %s has it",
                *(self._kind, point.name, self._package(loses), self._package(wins)),
            )
        return points

    @staticmethod
    def _package(point: importlib.metadata.EntryPoint) -> str:
        """The package of an entry point, with its version unless it is warpmpc."""
        if point.dist is None:
            return point.value
        return "warpmpc" if point.dist.name == "warpmpc" else f"{point.dist.name} {point.dist.version}"

    def register(self, name: str, thing: T) -> None:
        """Add one.

        Raises:
            ValueError: If there is one of this name.
        """
        if name in self:
            article = "an" if self._kind[0] in "aeiou" else "a"
            raise ValueError(f"there is {article} {self._kind} '{name}' already")
        self._known[name] = thing

    @contextmanager
    def apart(self) -> Iterator[dict[str, T]]:
        """Keep what is registered meanwhile out of the registry; yields it, by name."""
        known, found = self._known, {}
        self._known = dict(known)
        try:
            yield found
        finally:
            found |= {name: thing for name, thing in self._known.items() if known.get(name) is not thing}
            self._known = known

    @contextmanager
    def replaced(self, source: str) -> Iterator[list[str]]:
        """Undo what a file registered before; yields, in the end, the names of what it registers now.

        What it does not register again, since a module that does so is imported once, stays. Nothing of it stays
        registered where the file fails.

        Args:
            source: The file.
        """
        self.load_registered()
        own = {name: (self._known[name], before) for name, before in self._of_file.pop(source, {}).items()}
        for name, (_, before) in own.items():
            if before is None:
                del self._known[name]
            else:
                self._known[name] = before
        start, names = dict(self._known), []
        try:
            yield names
        except BaseException:
            self._known = start
            raise
        for name, (thing, _) in own.items():
            if self._known.get(name) is start.get(name):
                self._known[name] = thing
        names += [name for name, thing in self._known.items() if thing is not start.get(name)]
        self._of_file[source] = {name: start.get(name) for name in names}

    def find(self, name: str, *more: str) -> T:
        """The one of a name.

        Args:
            name: The name.
            more: Other names that the message lists.

        Raises:
            ValueError: If there is none, or its package cannot be imported.
        """
        if name not in self:
            raise ValueError(f"no {self._kind} '{name}'; there is: {', '.join((*more, *self))}")
        return self[name]

    def origin(self, name: str) -> str:
        """Words about where the one of a name comes from: warpmpc, an installed package, or this program."""
        if name in self.shipped:
            return "warpmpc"
        if name not in self._points:
            return "this program"
        return self._package(self._points[name])

    def __getitem__(self, name: str) -> T:
        if name in self._known:
            return self._known[name]
        if name not in self._loaded:
            point = self._points[name]
            try:
                self._loaded[name] = point.load()
            except Exception as error:  # of a package that is not ours
                why = f"{type(error).__name__}: {error}"
                raise ValueError(f"the {self._kind} '{name}' ({point.value}) cannot be loaded: {why}") from error
        return self._loaded[name]

    def __setitem__(self, name: str, thing: T) -> None:
        self._known[name] = thing

    def __delitem__(self, name: str) -> None:
        del self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._known, *self._points)))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in self._known or name in self._points


ENGINES: Registry[Any] = Registry("engine", "warpmpc.engines")
"""Engines, each a :class:`warpmpc.engine.registry.EngineEntry`."""
STRATEGIES: Registry[Any] = Registry("strategy", "warpmpc.strategies")
"""Strategies, each a function with the arguments of :class:`warpmpc.planner.strategy.SamplingStrategy`."""
TERMS: Registry[Any] = Registry("cost term", "warpmpc.terms")
"""Cost terms: the built-in ones, and those of installed packages, beside those that a program hands over."""
COMMANDS: Registry[Any] = Registry("command", "warpmpc.commands")
"""Commands of the program ``warpmpc`` beyond its core, each a function as Typer takes it."""
OBSERVERS: Registry[Any] = Registry("observer", "warpmpc.observers")
"""Observers of episodes, each made as :class:`warpmpc.loop.run.episode.Observer` says."""
ROBOTS: Registry[Any] = Registry("robot", "warpmpc.robots")
"""Drivers of robots, each ``make(scene, *, seed, task, terms, watch, compiled)``, as
:class:`~warpmpc.loop.robots.drivers.Driver`, with ``config``, a path, where a file was given, too; it returns a
:class:`~warpmpc.loop.realtime.loop.Robot`."""


class Name(StrEnum):
    """Names of a registry in scene files: the shipped ones are members, and registered ones become members.

    A subclass says ``registry = nonmember(...)``: the registry that knows the others.
    """

    registry: Registry

    @classmethod
    def names(cls) -> list[str]:
        """Names of all members and of all that is registered."""
        return list(dict.fromkeys((*cls, *cls.registry)))

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        return cls._member(value) if isinstance(value, str) and value in cls.registry else None

    @classmethod
    def _member(cls, value: str) -> Self:
        if value in cls._value2member_map_:
            return cls._value2member_map_[value]
        member = str.__new__(cls, value)
        member._name_ = member._value_ = value
        return member

    def __reduce_ex__(self, protocol: object) -> tuple[object, ...]:
        """A process that reads it may register the name later: from a file of the user's."""
        return self._member, (self._value_,)
