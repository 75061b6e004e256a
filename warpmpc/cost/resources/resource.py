# SPDX-License-Identifier: Apache-2.0
"""Resources of cost terms beyond their parameters: asked for while a term is bound, refreshed before every plan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from ...scene.model.layout import Layout
    from ...scene.schema import Scene
    from ...scene.task.observed import ObservedState
    from ...scene.task.task import Task


class Resource:
    """Something that terms of a stack share: distance fields, push values, a point cloud.

    A term asks for it with :meth:`Resources.get` while it is bound and hands over its parameters; ``allocate`` then
    fills in the arrays, which stay the same ones for good, so that captured graphs may hold them. A subclass overrides
    what it needs.
    """

    def __init__(self, resources: Resources): ...

    def allocate(self, envs: int, device: str) -> None:
        """Allocate for E environments and point the parameters of the terms at the arrays."""

    def before_plan(self, observed: ObservedState) -> None:
        """Follow what is observed, on the device; capture-safe."""

    def on_task_change(self, task: Task, names: frozenset[str]) -> None:
        """Take note that poses, scalars or weights changed; returns at once."""

    def refresh(self) -> None:
        """Hand over to the device what was prepared since the last plan; never waits."""

    def settle(self) -> None:
        """Wait until everything that is being prepared has been handed over."""

    def reset(self) -> None:
        """Forget earlier plans."""


R = TypeVar("R")


@dataclass
class Resources:
    """The resources of a stack by their kind, made when a term first asks for one."""

    scene: Scene
    layout: Layout
    _kinds: dict[type, Resource] = field(default_factory=dict)

    def get(self, kind: type[R]) -> R:
        """The resource of this kind."""
        if kind not in self._kinds:
            self._kinds[kind] = kind(self)
        return self._kinds[kind]

    def __iter__(self) -> Iterator[Resource]:
        return iter(list(self._kinds.values()))
